// The chunks of a static scene and the blocks that follow from them: what is fetched together, where it lies, how large
// it is.
import { hasBox, writeBox } from "./boxes.ts";
import { BLOCK, CHUNK_BYTES } from "./static-scene.ts";
import type { StaticScene } from "./static-scene.ts";
import { recordLayout } from "./tables.ts";

const REACH = 8; // 1/64 octaves

export class Blocks {
  readonly count: number;
  readonly chunk: Uint32Array; // chunk of each block
  readonly firstId: Uint32Array; // id of the first Gaussian of each block
  readonly start: Uint32Array; // (B + 1) place of its first Gaussian in the files
  readonly rows: Float32Array; // (8 C) as in `Batch.chunks`
  readonly boxes: Float32Array; // (6 C) as in `Batch.boxes`
  readonly levels: Uint8Array; // (2 C) first and last level
  // (5 C): center of each chunk, radius of its box and half the largest standard deviation, mean square of their
  // distance from the center
  readonly spheres: Float32Array;
  readonly top: number; // the highest level
  readonly meanRadius: number; // of the boxes of chunks
  termStart: Float64Array | null = null; // (B + 1) byte in `terms`; null until `setTerms`
  termCount: Uint16Array | null = null;

  constructor(readonly scene: StaticScene, data: Uint8Array) {
    const { header } = scene, view = new DataView(data.buffer, data.byteOffset, data.byteLength);
    const most = recordLayout(header.colors.variant).position;
    const c = header.chunks;
    this.top = header.levels.length - 1;
    this.rows = new Float32Array(8 * c);
    this.boxes = new Float32Array(6 * c);
    this.levels = new Uint8Array(2 * c);
    this.spheres = new Float32Array(5 * c);
    const counts = new Uint16Array(c);
    for (let k = 0; k < c; k++) {
      const at = CHUNK_BYTES * k, low = view.getInt16(at + 24, true), bits = view.getUint16(at + 31, true);
      let square = 0;
      for (let axis = 0; axis < 3; axis++) {
        this.rows[8 * k + axis] = view.getFloat32(at + 4 * axis, true);
        this.rows[8 * k + 4 + axis] = view.getFloat32(at + 12 + 4 * axis, true);
      }
      if (!hasBox(this.rows, k, bits, most)) {
        throw new Error(`chunks: row ${k}: expected a box, got none; export the scene again`);
      }
      writeBox(this.rows, k, bits, this.boxes, k);
      for (let axis = 0; axis < 3; axis++) {
        const start = this.boxes[6 * k + axis], half = (this.boxes[6 * k + 3 + axis] - start) / 2;
        this.spheres[5 * k + axis] = start + half;
        square += half * half;
      }
      this.rows[8 * k + 3] = low;
      this.rows[8 * k + 7] = view.getUint8(at + 28);
      this.spheres[5 * k + 3] = Math.sqrt(square) + 0.5 * 2 ** ((low + REACH * view.getUint8(at + 33)) / 64);
      this.spheres[5 * k + 4] = square / 3;
      this.levels[2 * k] = view.getUint8(at + 29);
      this.levels[2 * k + 1] = view.getUint8(at + 30);
      counts[k] = view.getUint16(at + 26, true);
      if (
        counts[k] < 1 || counts[k] > 256 || this.levels[2 * k] > this.levels[2 * k + 1] ||
        this.levels[2 * k + 1] > this.top
      ) {
        throw new Error(`chunks: row ${k}: expected 1 to 256 Gaussians of known levels; export the scene again`);
      }
    }
    let sum = 0;
    for (let k = 0; k < c; k++) sum += Math.sqrt(3 * this.spheres[5 * k + 4]);
    this.meanRadius = Math.max(sum / Math.max(c, 1), 1e-9);
    this.count = scene.blocks;
    this.chunk = new Uint32Array(this.count);
    this.firstId = new Uint32Array(this.count);
    this.start = new Uint32Array(this.count + 1);
    this.#lay(counts);
  }

  /**
   * Place the blocks: of each run of chunks with equal levels the first 64 of every chunk, then the next 64, and on.
   */
  #lay(counts: Uint16Array): void {
    const ids = new Float64Array(counts.length + 1);
    for (let k = 0; k < counts.length; k++) ids[k + 1] = ids[k] + counts[k];
    let block = 0, place = 0;
    for (let low = 0, high = 0; low < counts.length; low = high) {
      const alike = (k: number): boolean =>
        this.levels[2 * k] === this.levels[2 * low] && this.levels[2 * k + 1] === this.levels[2 * low + 1];
      while (high < counts.length && alike(high)) high++;
      for (let before = 0; before < 256; before += BLOCK) {
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
      throw new Error(
        `chunks: expected ${this.count} blocks of ${this.scene.header.gaussians} Gaussians, got ${block} of ${place};` +
          " export the scene again",
      );
    }
  }

  /** Take the number of terms of each block: the content of `blocks`. */
  setTerms(data: Uint8Array): void {
    const view = new DataView(data.buffer, data.byteOffset, data.byteLength);
    const starts = new Float64Array(this.count + 1), counts = new Uint16Array(this.count);
    for (let b = 0; b < this.count; b++) {
      counts[b] = view.getUint16(2 * b, true);
      starts[b + 1] = starts[b] + this.size(b) + this.scene.termBytes * counts[b];
    }
    if (starts[this.count] !== this.scene.files.get("terms")?.bytes) {
      throw new Error("blocks: expected as many terms as the scene has, got another number");
    }
    [this.termStart, this.termCount] = [starts, counts];
  }

  /** Return the number of Gaussians of a block. */
  size(block: number): number {
    return this.start[block + 1] - this.start[block];
  }

  /** Return the last level of the Gaussians of a block. */
  last(block: number): number {
    return this.levels[2 * this.chunk[block] + 1];
  }
}
