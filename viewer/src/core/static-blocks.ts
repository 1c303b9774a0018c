// The chunks of a static scene and the blocks that follow from them: what is fetched together, where it lies, how large
// it is, and what it holds.
import { hasBox, writeBox } from "./boxes.ts";
import { readRecords, readTerms } from "./coding.ts";
import { BLOCK } from "./static-scene.ts";
import type { StaticScene } from "./static-scene.ts";
import { Columns, damaged, inflate } from "./static-tables.ts";
import { recordLayout } from "./tables.ts";

const UNIT = 16, HEAD = 32; // bytes
const MOST_MEMBERS = 256;
const PICTURE = 0.1; // largest share of the Gaussians in a first picture, as on a server
const STEPS = 64, OCTAVE = 4; // of places, and of radii

export class Blocks {
  readonly count: number;
  readonly chunk: Uint32Array; // chunk of each block
  readonly firstId: Uint32Array; // id of the first Gaussian of each block
  readonly start: Uint32Array; // (B + 1) place of its first Gaussian in the files
  readonly recordStart: Float64Array; // (B + 1) byte in `records`
  readonly rows: Float32Array; // (8 C) as in `Batch.chunks`, from the first block of a chunk on
  readonly boxes: Float32Array; // (6 C) as in `Batch.boxes`
  readonly levels: Uint8Array; // (2 C) first and last level
  readonly spheres: Float32Array; // (4 C): what each chunk reaches
  readonly top: number; // the highest level
  readonly lowest: number; // the lowest level that is no first picture; those are for servers
  readonly meanRadius: number; // of the spheres of chunks
  readonly harmonicBytes: number; // of a Gaussian
  // Of items, layers of the terms of blocks: item i belongs to block i % B.
  termStart: Float64Array | null = null; // (L B + 1) byte in `terms`; null until `setTerms`

  /** Read the content of `index`. */
  static async open(scene: StaticScene, data: Uint8Array): Promise<Blocks> {
    const bytes = 13 * scene.header.chunks + 2 * scene.blocks;
    return new Blocks(scene, await inflate(data, bytes, "index"));
  }

  constructor(readonly scene: StaticScene, index: Uint8Array) {
    const { header, middle, scale } = scene, c = header.chunks, columns = new Columns(index, c);
    if (index.length !== 13 * c + 2 * scene.blocks) throw damaged("index");
    this.top = header.levels.length - 1;
    this.count = scene.blocks;
    this.harmonicBytes = header.harmonics ? 3 * ((header.harmonics.degree + 1) ** 2 - 1) : 0;
    this.rows = new Float32Array(8 * c);
    this.boxes = new Float32Array(6 * c);
    this.levels = new Uint8Array(2 * c);
    this.spheres = new Float32Array(4 * c);
    for (let axis = 0; axis < 3; axis++) {
      columns.sums(3).forEach((place, k) => {
        this.spheres[4 * k + axis] = middle[axis] + scale * Math.sinh(place / STEPS);
      });
    }
    let sum = 0;
    columns.next(1).forEach((value, k) => {
      sum += this.spheres[4 * k + 3] = scale * 2 ** ((value - 128) / OCTAVE);
    });
    this.meanRadius = Math.max(sum / Math.max(c, 1), 1e-9);
    const counts = columns.next(1).map((value) => value + 1);
    for (const end of [0, 1]) columns.next(1).forEach((level, k) => (this.levels[2 * k + end] = level));
    for (let k = 0; k < c; k++) {
      if (this.levels[2 * k] > this.levels[2 * k + 1] || this.levels[2 * k + 1] > this.top) {
        throw damaged("index");
      }
    }
    this.lowest = this.#lowest(c);
    this.chunk = new Uint32Array(this.count);
    this.firstId = new Uint32Array(this.count);
    this.start = new Uint32Array(this.count + 1);
    this.#lay(counts);
    this.recordStart = new Float64Array(this.count + 1);
    columns.next(2, this.count).forEach((units, b) => {
      this.recordStart[b + 1] = this.recordStart[b] + UNIT * units;
    });
    if (this.recordStart[this.count] !== scene.files.get("records")!.bytes) throw damaged("index");
  }

  /** Return the lowest level that is large or shares chunks with the level above it. */
  #lowest(chunks: number): number {
    const counts = this.scene.header.levels.map((level) => level.count);
    for (let low = 0; low < this.top; low++) {
      if (counts[low] > PICTURE * counts[this.top]) return low;
      for (let k = 0; k < chunks; k++) if (this.levels[2 * k] <= low && this.levels[2 * k + 1] > low) return low;
    }
    return this.top;
  }

  /**
   * Place the blocks: of each run of chunks with equal levels the first 64 of every chunk, then the next 64, and on.
   */
  #lay(counts: Uint32Array): void {
    const ids = new Float64Array(counts.length + 1);
    for (let k = 0; k < counts.length; k++) ids[k + 1] = ids[k] + counts[k];
    let block = 0, place = 0;
    for (let low = 0, high = 0; low < counts.length; low = high) {
      const alike = (k: number): boolean =>
        this.levels[2 * k] === this.levels[2 * low] && this.levels[2 * k + 1] === this.levels[2 * low + 1];
      while (high < counts.length && alike(high)) high++;
      for (let before = 0; before < MOST_MEMBERS; before += BLOCK) {
        for (let k = low; k < high; k++) {
          if (counts[k] <= before) continue;
          if (block < this.count) {
            this.chunk[block] = k;
            this.firstId[block] = ids[k] + before;
            place += Math.min(BLOCK, counts[k] - before);
            this.start[block + 1] = place;
          }
          block++;
        }
      }
    }
    if (block !== this.count || place !== this.scene.header.gaussians) {
      throw damaged("index");
    }
  }

  /**
   * Return the records of a block and the blocks that replace each Gaussian, and take the row of its chunk; `data` is
   * what `records` has of it.
   */
  records(block: number, data: Uint8Array): { records: Uint32Array; needs: Uint32Array[] } {
    const c = this.chunk[block], size = this.size(block), { header } = this.scene, row = new Float32Array(8);
    const view = new DataView(data.buffer, data.byteOffset, data.byteLength);
    for (let axis = 0; axis < 3; axis++) {
      row[axis] = view.getFloat32(4 * axis, true);
      row[4 + axis] = view.getFloat32(12 + 4 * axis, true);
    }
    row[3] = view.getInt16(24, true);
    row[7] = data[30];
    const bits = view.getUint16(26, true), end = HEAD + 2 * view.getUint16(28, true);
    const body = data.slice(HEAD, end), ids = new Uint32Array(size).map((_, k) => k);
    const records = !hasBox(row, 0, bits, recordLayout(header.colors.variant).position) || row[7] < 1
      ? null
      : header.code
      ? readRecords(body, ids, new Uint32Array(size), { table: row, bits: Uint16Array.of(bits) }, header.code)
      : body.length === 16 * size ? new Uint32Array(body.buffer) : null;
    const needs = this.last(block) < this.top ? readNeeds(data.subarray(end), size) : [];
    if (!records || !needs) throw damaged(`records: block ${block}`);
    this.rows.set(row, 8 * c);
    writeBox(row, 0, bits, this.boxes.subarray(6 * c), 0);
    return { records, needs };
  }

  /** Return the terms of an item and the Gaussian in the block of each; `data` is what `terms` has of it. */
  terms(item: number, data: Uint8Array): { owners: Uint32Array; terms: Uint32Array } {
    const size = this.size(item % this.count), of: number[] = [], { code } = this.scene.header;
    let bit = 0;
    for (; data.length > 0 && bit - of.length < size; bit++) {
      if ((data[bit >> 3] >> (bit & 7)) & 1) of.push(bit - of.length);
    }
    const owners = Uint32Array.from(of), terms = code && readTerms(data.slice(2 * ((bit + 15) >> 4)), owners, code);
    if (!terms) throw damaged(`terms: block ${item % this.count}`);
    return { owners, terms };
  }

  /** Take where items lie: the content of `blocks`. */
  async setTerms(data: Uint8Array): Promise<void> {
    const items = this.scene.layers * this.count, starts = new Float64Array(items + 1);
    new Columns(await inflate(data, 2 * items, "blocks"), items).next(2).forEach((words, i) => {
      starts[i + 1] = starts[i] + 2 * words;
    });
    if (starts[items] !== this.scene.files.get("terms")?.bytes) {
      throw damaged("blocks");
    }
    this.termStart = starts;
  }

  /** Return the number of Gaussians of a block. */
  size(block: number): number {
    return this.start[block + 1] - this.start[block];
  }

  /** Return the bytes of records and harmonics of blocks, or of items, from one to another. */
  bytes(first: number, end: number, terms = false): number {
    return terms
      ? this.termStart![end] - this.termStart![first]
      : this.recordStart[end] - this.recordStart[first] + this.harmonicBytes * (this.start[end] - this.start[first]);
  }

  /** Return the last level of the Gaussians of a block. */
  last(block: number): number {
    return this.levels[2 * this.chunk[block] + 1];
  }
}

/** Return the blocks that replace each of `size` Gaussians; null for bytes that are no such lists. */
function readNeeds(data: Uint8Array, size: number): Uint32Array[] | null {
  const found: Uint32Array[] = [];
  let at = 0, last = 0;
  while (found.length < size) {
    found.push(Uint32Array.from({ length: data[at++] ?? 0 }, () => {
      let folded = 0, shift = 0;
      do folded |= (data[at] & 127) << shift; while (shift += 7, data[at++] > 127);
      return last += (folded >>> 1) ^ -(folded & 1);
    }));
  }
  return at > data.length ? null : found;
}
