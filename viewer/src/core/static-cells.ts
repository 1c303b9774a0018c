// The cells of a static scene: which cell an eye is in, where its row lies, and what that row says.
import type { StaticScene } from "./static-scene.ts";
import { Columns, damaged, inflate } from "./static-tables.ts";

/**
 * What a cell sees: blocks, the logarithm (base 2) of the gain of each, and layer by layer that of its items, -Infinity
 * for those of no use here.
 */
export interface CellRow {
  blocks: Uint32Array;
  gains: Float32Array;
  items: Float32Array | null;
  middle: readonly number[] | null; // where gains were taken; null if they know no distance
}

export class Cells {
  readonly #boxes: Int32Array; // (3 C)
  readonly #starts: Float64Array; // (C + 1) bytes in `cells`
  readonly #byBox = new Map<string, number>();

  /** Read the content of `grid`. */
  static async open(scene: StaticScene, data: Uint8Array): Promise<Cells> {
    return new Cells(scene, await inflate(data, 16 * scene.cells.count, "grid"));
  }

  constructor(private readonly scene: StaticScene, data: Uint8Array) {
    const { count } = scene.cells, columns = new Columns(data, count);
    if (data.length !== 16 * count) throw damaged("grid");
    this.#boxes = new Int32Array(3 * count);
    this.#starts = new Float64Array(count + 1);
    for (let axis = 0; axis < 3; axis++) columns.sums(4).forEach((box, k) => (this.#boxes[3 * k + axis] = box));
    columns.next(4).forEach((bytes, k) => {
      this.#starts[k + 1] = this.#starts[k] + bytes;
      this.#byBox.set(this.#key(k, 0, 0, 0), k);
    });
    if (this.#starts[count] !== scene.files.get("cells")?.bytes) {
      throw damaged("grid");
    }
  }

  /** Return the cell that holds a position; if none does, the one with the nearest center. */
  at(position: readonly number[]): number {
    const { origin, size, count } = this.scene.cells;
    if (!(size > 0) || count === 1) return 0;
    const box = position.map((v, axis) => Math.floor((v - origin[axis]) / size));
    const found = this.#byBox.get(box.join());
    if (found !== undefined) return found;
    let best = 0, least = Infinity;
    for (let k = 0; k < count; k++) {
      const away = Math.hypot(...this.middle(k)!.map((v, axis) => v - position[axis]));
      if (away < least) [best, least] = [k, away];
    }
    return best;
  }

  /** Return the cells that touch a cell at a face. */
  beside(cell: number): number[] {
    const found: number[] = [];
    for (const [x, y, z] of [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]] as const) {
      const other = this.#byBox.get(this.#key(cell, x, y, z));
      if (other !== undefined && other !== cell) found.push(other);
    }
    return found;
  }

  /** Return the middle of a cell; null if there is one cell alone. */
  middle(cell: number): number[] | null {
    const { origin, size } = this.scene.cells;
    return size > 0 ? origin.map((v, axis) => v + size * (this.#boxes[3 * cell + axis] + 0.5)) : null;
  }

  /** Return where the row of a cell lies. */
  range(cell: number): [number, number] {
    return [this.#starts[cell], this.#starts[cell + 1]];
  }

  #key(cell: number, x: number, y: number, z: number): string {
    return [this.#boxes[3 * cell] + x, this.#boxes[3 * cell + 1] + y, this.#boxes[3 * cell + 2] + z].join();
  }
}

/** Return the content of the row of a cell with this middle. */
export async function readRow(
  scene: StaticScene, coded: Uint8Array, middle: readonly number[] | null,
): Promise<CellRow> {
  const bits = Math.ceil(scene.blocks / 8), each = scene.cells.active ? 1 + scene.layers : 1, seen: number[] = [];
  const data = await inflate(coded, bits + each * scene.blocks, "cells");
  for (let b = 0; b < scene.blocks && b >> 3 < data.length; b++) if ((data[b >> 3] >> (b & 7)) & 1) seen.push(b);
  if (data.length !== bits + each * seen.length) {
    throw damaged("cells");
  }
  const gains = new Float32Array(seen.length);
  for (let k = 0; k < seen.length; k++) gains[k] = (data[bits + k] - 255 + scene.cells.gainTop) / 4;
  const items = scene.cells.active
    ? Float32Array.from(data.subarray(bits + seen.length), (octave) => octave > 0 ? octave - 128 : -Infinity) : null;
  return { blocks: Uint32Array.from(seen), gains, items, middle };
}

/** Return a row with all blocks alike: what a cell is taken to see whose own row is lost. */
export function everything(scene: StaticScene): CellRow {
  return {
    blocks: Uint32Array.from({ length: scene.blocks }, (_, b) => b), gains: new Float32Array(scene.blocks),
    items: null, middle: null,
  };
}
