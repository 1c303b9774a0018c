// Roaring bitmaps in their portable format, as the reference library writes them after run optimization.
import { countOf } from "./bits.ts";

const WITH_RUNS = 12347, WITHOUT_RUNS = 12346; // cookies
const ARRAY_MOST = 4096; // entries; more are a bitmap
const BITMAP_BYTES = 8192;
const OFFSETS_FROM = 4; // containers: fewer have no offsets beside runs
const WORDS = 2048; // of 32 bits, for 2^16 ids

/** The ids of one value of the upper 16 bits. */
interface Container {
  key: number;
  words: Uint32Array;
  count: number;
  runs: number; // 0 unless it is written as runs
  bytes: number;
}

/** Return the portable bitmap of a packed set. */
export function serialize(set: Uint32Array): Uint8Array<ArrayBuffer> {
  const found: Container[] = [];
  for (let at = 0; at < set.length; at += WORDS) {
    const container = containerOf(at / WORDS, set.subarray(at, at + WORDS));
    if (container !== null) found.push(container);
  }
  const size = found.length, runs = found.some((container) => container.runs > 0);
  const offsets = !runs || size >= OFFSETS_FROM;
  const head = (runs ? 4 + Math.ceil(size / 8) : 8) + 4 * size + (offsets ? 4 * size : 0);
  const out = new Uint8Array(found.reduce((sum, container) => sum + container.bytes, head));
  const data = new DataView(out.buffer);
  data.setUint32(0, runs ? WITH_RUNS + (size - 1) * 65536 : WITHOUT_RUNS, true);
  let at = 4;
  if (runs) {
    found.forEach((container, k) => { if (container.runs > 0) out[4 + (k >>> 3)] |= 1 << (k & 7); });
    at += Math.ceil(size / 8);
  } else {
    data.setUint32(4, size, true);
    at += 4;
  }
  for (const { key, count } of found) {
    data.setUint16(at, key, true);
    data.setUint16(at + 2, count - 1, true);
    at += 4;
  }
  let body = head;
  for (const container of found) {
    if (offsets) data.setUint32(at, body, true);
    if (offsets) at += 4;
    write(container, data, body);
    body += container.bytes;
  }
  return out;
}

function containerOf(key: number, words: Uint32Array): Container | null {
  let count = 0, runs = 0, before = 0;
  for (const word of words) {
    count += countOf(word);
    runs += countOf(word & ~((word << 1) | before));
    before = word >>> 31;
  }
  if (count === 0) return null;
  const plain = count > ARRAY_MOST ? BITMAP_BYTES : 2 * count;
  const shorter = 2 + 4 * runs < plain;
  return { key, words, count, runs: shorter ? runs : 0, bytes: shorter ? 2 + 4 * runs : plain };
}

function write({ words, count, runs }: Container, data: DataView, from: number): void {
  let at = from;
  if (runs === 0 && count > ARRAY_MOST) {
    words.forEach((word, k) => data.setUint32(at + 4 * k, word, true));
    return;
  }
  if (runs > 0) {
    data.setUint16(at, runs, true);
    at += 2;
  }
  let first = -1, last = -2;
  const flush = () => {
    if (first < 0) return;
    data.setUint16(at, first, true);
    data.setUint16(at + 2, last - first, true);
    at += 4;
  };
  words.forEach((word, k) => {
    for (let rest = word; rest !== 0; rest &= rest - 1) {
      const id = 32 * k + 31 - Math.clz32(rest & -rest);
      if (runs === 0) {
        data.setUint16(at, id, true);
        at += 2;
        continue;
      }
      if (id !== last + 1) {
        flush();
        first = id;
      }
      last = id;
    }
  });
  if (runs > 0) flush();
}

/** Return holdings: Gaussians received, terms received, and Gaussians replaced, of a scene of N and T. */
export function holdings(
  gaussians: number, terms: number, sets: [Uint32Array, Uint32Array, Uint32Array],
): Uint8Array<ArrayBuffer> {
  const bitmaps = sets.map(serialize);
  const out = new Uint8Array(bitmaps.reduce((sum, bitmap) => sum + bitmap.length, 24));
  const data = new DataView(out.buffer);
  out.set([0x47, 0x56, 0x48, 0x31]); // GVH1
  [
    gaussians, terms, ...bitmaps.map((bitmap) => bitmap.length),
  ].forEach((value, k) => data.setUint32(4 + 4 * k, value, true));
  let at = 24;
  for (const bitmap of bitmaps) {
    out.set(bitmap, at);
    at += bitmap.length;
  }
  return out;
}
