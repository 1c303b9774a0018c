// Bitmaps of holdings: known bytes, and sets that come back from them. tests/viewer compares with the reference
// library.
import assert from "node:assert/strict";
import { test } from "node:test";
import { add, has } from "../src/core/bits.ts";
import { holdings, serialize } from "../src/core/roaring.ts";
import { hex } from "./fakes.ts";

function setOf(ids: Iterable<number>, size: number): Uint32Array {
  const set = new Uint32Array(Math.ceil(size / 32));
  for (const id of ids) add(set, id);
  return set;
}

function range(from: number, to: number, step = 1): number[] {
  return Array.from({ length: Math.ceil((to - from) / step) }, (_, k) => from + k * step);
}

/** Read a portable bitmap, as its specification has it. */
function parse(bytes: Uint8Array): { ids: number[]; kinds: string } {
  const data = new DataView(bytes.buffer), cookie = data.getUint32(0, true), hasRuns = (cookie & 0xffff) === 12347;
  const size = hasRuns ? (cookie >>> 16) + 1 : data.getUint32(4, true);
  const flags = hasRuns ? bytes.subarray(4, 4 + Math.ceil(size / 8)) : new Uint8Array(Math.ceil(size / 8));
  const keys = hasRuns ? 4 + flags.length : 8, offsets = keys + 4 * size;
  let at = offsets + (!hasRuns || size >= 4 ? 4 * size : 0), kinds = "";
  const ids: number[] = [];
  for (let k = 0; k < size; k++) {
    const base = 65536 * data.getUint16(keys + 4 * k, true), count = data.getUint16(keys + 4 * k + 2, true) + 1,
      before = ids.length;
    if (!hasRuns || size >= 4) assert.equal(data.getUint32(offsets + 4 * k, true), at);
    if ((flags[k >>> 3] >>> (k & 7)) & 1) {
      const runs = data.getUint16(at, true);
      for (let r = 0; r < runs; r++) {
        const first = data.getUint16(at + 2 + 4 * r, true);
        ids.push(...range(base + first, base + first + data.getUint16(at + 4 + 4 * r, true) + 1));
      }
      at += 2 + 4 * runs;
      kinds += "r";
    } else if (count > 4096) {
      for (let id = 0; id < 65536; id++) if ((bytes[at + (id >>> 3)] >>> (id & 7)) & 1) ids.push(base + id);
      at += 8192;
      kinds += "b";
    } else {
      for (let i = 0; i < count; i++) ids.push(base + data.getUint16(at + 2 * i, true));
      at += 2 * count;
      kinds += "a";
    }
    assert.equal(ids.length - before, count);
  }
  assert.equal(at, bytes.length);
  return { ids, kinds };
}

test("small bitmaps have the bytes of the specification", () => {
  assert.equal(hex(serialize(new Uint32Array(0))), "3a30000000000000");
  assert.equal(
    hex(serialize(setOf([1, 5, 65535], 65536))),
    "3a300000" + "01000000" + "0000" + "0200" + "10000000" + "010005" + "00" + "ffff",
  );
  assert.equal(hex(serialize(setOf(range(10, 20), 100))), "3b300000" + "01" + "0000" + "0900" + "0100" + "0a000900");
});

test("every kind of container comes back, also in bitmaps of many", () => {
  const pieces: [number[], string][] = [
    [[0, 7, 65535], "a"],
    [range(65536, 131072), "r"],
    [range(131072, 196608, 3), "b"],
    [range(5 * 65536, 5 * 65536 + 8192, 2), "a"],
    [[...range(6 * 65536, 6 * 65536 + 100), ...range(6 * 65536 + 200, 6 * 65536 + 60000)], "r"],
    [range(9 * 65536 + 65000, 10 * 65536), "r"],
  ];
  for (let count = 0; count <= pieces.length; count++) {
    const ids = pieces.slice(0, count).flatMap(([some]) => some);
    const found = parse(serialize(setOf(ids, 10 * 65536)));
    assert.deepEqual(found.ids, ids);
    assert.equal(found.kinds, pieces.slice(0, count).map(([, kind]) => kind).join(""));
  }
});

test("holdings have their head, and a set whose size is no multiple of 32 is whole", () => {
  const sent = setOf(range(0, 45), 45), bytes = holdings(45, 7, [sent, setOf([6], 7), setOf([44], 45)]);
  const data = new DataView(bytes.buffer), heads = range(0, 6).map((k) => data.getUint32(4 * k, true));
  assert.deepEqual(heads.slice(0, 3), [0x31485647, 45, 7]);
  assert.equal(24 + heads[3] + heads[4] + heads[5], bytes.length);
  assert.deepEqual(parse(bytes.slice(24, 24 + heads[3])).ids, range(0, 45));
  assert.ok(has(sent, 44) && !has(sent, 45));
});
