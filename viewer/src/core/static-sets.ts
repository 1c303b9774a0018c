// Sets of harmonics that the Gaussians of a bare scene share (docs/static.md): blocks of them, those of most worth first.
import { damaged, inflate } from "./static-tables.ts";
import type { HarmonicTables } from "./types.ts";

const NEAR = 64; // sets that are put together at a time
const BLOCK = 1024; // sets

/** What is known of each block before it comes. */
export interface SetBlocks {
  bytes: number[];
  worth: number[]; // mean squared change of color, over the whole scene
}

/** Return the number of blocks of so many sets. */
export function blocksOf(sets: number): number {
  return Math.ceil(sets / BLOCK);
}

/** Return how many bytes name a set. */
export function labelBytes(tables: HarmonicTables | null): number {
  return tables === null ? 0 : Math.max(1, Math.ceil(Math.log2(tables.sets) / 8));
}

/** Return the number of the first set of a block, and its sets: 3 K bytes each, for each coefficient R, G and B. */
export async function readSets(
  data: Uint8Array, block: number, tables: HarmonicTables,
): Promise<{ first: number; sets: Uint8Array }> {
  const first = BLOCK * block, count = Math.min(BLOCK, tables.sets - first);
  const each = 3 * ((tables.degree + 1) ** 2 - 1), where = `sets ${block}`;
  const packed = await inflate(data, each * count, where);
  if (packed.length !== each * count) throw damaged(where);
  const sets = new Uint8Array(each * count), values = new Uint8Array(each).fill(128);
  for (let low = 0; low < count; low += NEAR) { // all columns of some sets, so that what is written stays in the cache
    const high = Math.min(low + NEAR, count);
    for (let k = 0; k < each; k++) {
      let value = values[k];
      for (let i = low, at = count * k; i < high; i++) sets[each * i + k] = value += packed[at + i];
      values[k] = value;
    }
  }
  return { first, sets };
}
