// Parts of a bare scene for pages on the same machine (docs/static.md): arrays as the GPU takes them. Each comes once, with
// the harmonics of its Gaussians, so nothing has to be looked up, and only centers are decoded.
import { hasBox, writeBox } from "./boxes.ts";
import { damaged } from "./static-tables.ts";
import { recordLayout } from "./tables.ts";
import type { Batch, Header } from "./types.ts";
import { harmonicTexels } from "./colors.ts";

const HEAD = 16, CHUNK = 36, RECORD = 16, TEXEL = 16; // bytes
const MOST_MEMBERS = 256; // of a chunk

/** Sets of harmonics, as whole texels, and the number of the first. */
export interface PlainSets {
  first: number;
  sets: Uint8Array;
}

/** What has come, as the batches that a renderer takes. */
export class PlainArrivals {
  gaussians = 0;
  readonly terms = 0;
  #rows = 0; // of chunks

  constructor(private readonly header: Header) {}

  /** Return the batch of a part, and its harmonics; null without any. The batch takes the data. */
  add(data: Uint8Array, where: string): { batch: Batch; harmonics: PlainSets | null } {
    const { header } = this, texels = header.harmonics === null ? 0 : harmonicTexels(header.harmonics);
    if (data.length < HEAD || data.byteOffset % 4 !== 0) throw damaged(where);
    const [first, count, chunks, width] = new Uint32Array(data.buffer, data.byteOffset, 4);
    const records = HEAD + CHUNK * chunks, sets = records + RECORD * count;
    const isWhole = data.length === sets + width * count && width === TEXEL * texels;
    const most = header.gaussians - Math.max(first, this.gaussians);
    if (!isWhole || count > most || this.#rows + chunks > header.chunks) throw damaged(where);
    const table = new Float32Array(data.buffer, data.byteOffset + HEAD, 8 * chunks).slice();
    const sizes = new Uint32Array(data.buffer, data.byteOffset + HEAD + 32 * chunks, chunks);
    const batch: Batch = {
      first: this.gaussians, ids: new Uint32Array(count), rows: rowsOf(sizes, count, this.#rows, where),
      records: new Uint32Array(data.buffer, data.byteOffset + records, 4 * count).slice(),
      means: new Float32Array(0), firstRow: this.#rows, chunks: table, boxes: boxesOf(table, sizes, header, where),
      chunkLevels: new Uint8Array(2 * chunks), labels: header.harmonics === null ? null : new Uint32Array(count),
      firstTerm: 0, terms: new Uint32Array(0), owners: new Uint32Array(0), gone: new Uint32Array(0),
    };
    for (let i = 0; i < count; i++) batch.ids[i] = first + i;
    batch.labels?.set(batch.ids);
    this.gaussians += count;
    this.#rows += chunks;
    return { batch, harmonics: texels === 0 ? null : { first, sets: data.slice(sets) } };
  }
}

/** Return the row of the chunk of each Gaussian; rows are numbered from `first` on. */
function rowsOf(sizes: Uint32Array, count: number, first: number, where: string): Uint32Array {
  const rows = new Uint32Array(count);
  let at = 0;
  sizes.forEach((size, k) => {
    const members = size & 0xffff;
    if (members < 1 || members > MOST_MEMBERS || at + members > count) throw damaged(where);
    rows.fill(first + k, at, at += members);
  });
  if (at !== count) throw damaged(where);
  return rows;
}

/** Return the boxes of chunks, a low and a high corner each. */
function boxesOf(table: Float32Array, sizes: Uint32Array, header: Header, where: string): Float32Array {
  const boxes = new Float32Array(6 * sizes.length), most = recordLayout(header.colors.variant).position;
  sizes.forEach((size, k) => {
    const bits = size >>> 16;
    if (!hasBox(table, k, bits, most) || !(table[8 * k + 7] >= 1)) throw damaged(where);
    writeBox(table, k, bits, boxes, k);
  });
  return boxes;
}
