// The rows of chunks that have come: boxes that records are relative to, by rising first ids.
import { CHUNK_BYTES } from "./batch.ts";
import { hasBox } from "./boxes.ts";
import { recordLayout } from "./tables.ts";
import type { Header } from "./types.ts";

const MOST_MEMBERS = 256;

type Refuse = (what: string) => never;

/** Rows of chunks. `starts` rises; `rows` numbers each of them in the order of arrival, which all else has. */
export interface Chunks {
  starts: Uint32Array<ArrayBuffer>;
  rows: Uint32Array<ArrayBuffer>;
  counts: Uint16Array<ArrayBuffer>;
  table: Float32Array<ArrayBuffer>; // (8 C) as in `Batch`
  bits: Uint16Array<ArrayBuffer>; // of places on x, y and z, four bits each
}

/** Return no chunks. */
export function noChunks(): Chunks {
  return {
    starts: new Uint32Array(0), rows: new Uint32Array(0), counts: new Uint16Array(0), table: new Float32Array(0),
    bits: new Uint16Array(0),
  };
}

/** Return the chunks with new ones, whose rows are 33 bytes each. `refuse` raises for what does not fit the scene. */
export function addChunks(
  before: Chunks, fresh: Uint32Array, bytes: Uint8Array, about: Header, refuse: Refuse,
): Chunks {
  if (fresh.length === 0) return before;
  const held = before.starts.length, n = held + fresh.length;
  if (n > about.chunks) refuse(`expected at most ${about.chunks} chunks, got ${n}`);
  const table = new Float32Array(8 * n), counts = new Uint16Array(n), bits = new Uint16Array(n);
  const most = recordLayout(about.colors.variant).position;
  table.set(before.table);
  counts.set(before.counts);
  bits.set(before.bits);
  const data = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  for (let k = 0; k < fresh.length; k++) {
    const row = held + k;
    bits[row] = data.getUint16(CHUNK_BYTES * k + 31, true);
    readRow(data, CHUNK_BYTES * k, table.subarray(8 * row, 8 * (row + 1)), about.levels.length, refuse);
    if (!hasBox(table, row, bits[row], most)) refuse("expected chunks with a box, got others");
    counts[held + k] = data.getUint16(CHUNK_BYTES * k + 26, true);
    if (counts[held + k] < 1 || counts[held + k] > MOST_MEMBERS) {
      refuse(
        `expected chunks of 1 to ${MOST_MEMBERS} Gaussians, got others`
      );
    }
  }
  const starts = new Uint32Array(n), rows = new Uint32Array(n);
  for (let k = 0, a = 0, b = 0; k < n; k++) {
    const isOld = b === fresh.length || (a < held && before.starts[a] <= fresh[b]);
    starts[k] = isOld ? before.starts[a] : fresh[b];
    rows[k] = isOld ? before.rows[a++] : held + b++;
    if (
      k > 0 && starts[k - 1] + counts[rows[k - 1]] > starts[k]
    ) {
      refuse("expected chunks that do not overlap, got others");
    }
  }
  if (starts[n - 1] + counts[rows[n - 1]] > about.gaussians) refuse("expected chunks of this scene, got others");
  return { starts, rows, counts, table, bits };
}

/** Read a row to its eight numbers of the table, and check it. */
function readRow(data: DataView, at: number, to: Float32Array, levels: number, refuse: Refuse): void {
  for (let i = 0; i < 3; i++) {
    to[i] = data.getFloat32(at + 4 * i, true);
    to[4 + i] = data.getFloat32(at + 12 + 4 * i, true);
  }
  to[3] = data.getInt16(at + 24, true);
  to[7] = data.getUint8(at + 28);
  if (to[7] < 1) refuse("expected a stride of at least 1, got 0");
  const first = data.getUint8(at + 29), last = data.getUint8(at + 30);
  if (first > last || last >= levels) refuse(`expected levels of chunks in order and below ${levels}, got others`);
}

/** Return the row of the chunk of each of these rising ids. */
export function rowsOf(ids: Uint32Array, { starts, rows, counts }: Chunks, refuse: Refuse): Uint32Array<ArrayBuffer> {
  const out = new Uint32Array(ids.length);
  let low = 0, high = starts.length;
  while (ids.length > 0 && low < high) { // chunks that begin at or before the first id
    const middle = (low + high) >>> 1;
    if (starts[middle] <= ids[0]) low = middle + 1;
    else high = middle;
  }
  let at = low - 1;
  for (let i = 0; i < ids.length; i++) {
    while (at + 1 < starts.length && starts[at + 1] <= ids[i]) at++;
    if (at < 0 || ids[i] - starts[at] >= counts[rows[at]]) {
      refuse(`expected the row of the chunk of ${ids[i]}, got none`);
    }
    out[i] = rows[at];
  }
  return out;
}
