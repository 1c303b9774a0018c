// The cells of a static scene: which cell an eye is in, and what its row says.
import type { StaticScene } from "./static-scene.ts";
import { Columns, damaged, inflate } from "./static-tables.ts";

const STEPS = 32, OCTAVE = 4; // of the center of a sphere for each radius, and of its radius

/** What a cell sees: for each part its gain, what its terms are worth, and where its light is. */
export interface CellRow {
  gains: Float32Array; // (P)
  terms: Float32Array | null; // (P)
  middle: readonly number[] | null; // of the cell; null where one cell is everywhere
  spheres: Float32Array | null; // (4 P) center, in radii from that of the part, and radius over its own
  glances: Uint32Array; // bytes of the glance of each sector
}

export class Cells {
  readonly #boxes: Int32Array; // (3 C)
  readonly bytes: Uint32Array; // of the row of each
  readonly #byBox = new Map<string, number>();

  /** Read the content of `grid`. */
  static async open(scene: StaticScene, data: Uint8Array): Promise<Cells> {
    return new Cells(scene, await inflate(data, 16 * scene.cells.count, "grid"));
  }

  constructor(private readonly scene: StaticScene, data: Uint8Array) {
    const { count } = scene.cells, columns = new Columns(data, count);
    if (data.length !== 16 * count) throw damaged("grid");
    this.#boxes = new Int32Array(3 * count);
    for (let axis = 0; axis < 3; axis++) columns.sums(4).forEach((box, k) => (this.#boxes[3 * k + axis] = box));
    this.bytes = columns.next(4);
    for (let k = 0; k < count; k++) this.#byBox.set(this.#key(k, 0, 0, 0), k);
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

  #key(cell: number, x: number, y: number, z: number): string {
    return [this.#boxes[3 * cell] + x, this.#boxes[3 * cell + 1] + y, this.#boxes[3 * cell + 2] + z].join();
  }
}

/** Return the content of the row of a cell with this middle. */
export async function readRow(
  scene: StaticScene, coded: Uint8Array, middle: readonly number[] | null,
): Promise<CellRow> {
  const { parts, cells } = scene, bits = Math.ceil(parts / 8), seen: number[] = [];
  const each = 1 + (cells.active ? 1 : 0) + (cells.spheres ? 4 : 0), sectors = cells.glances?.sectors ?? 0;
  const data = await inflate(coded, bits + each * parts + 4 * sectors, "row");
  for (let p = 0; p < parts && p >> 3 < data.length; p++) if ((data[p >> 3] >> (p & 7)) & 1) seen.push(p);
  if (data.length !== bits + each * seen.length + 4 * sectors) throw damaged("row");
  const column = (k: number): Uint8Array => data.subarray(bits + k * seen.length, bits + (k + 1) * seen.length);
  const gains = new Float32Array(parts), terms = cells.active ? new Float32Array(parts) : null;
  const spheres = cells.spheres ? new Float32Array(4 * parts).map((_, k) => (k % 4 < 3 ? 0 : 1)) : null;
  seen.forEach((p, k) => {
    gains[p] = 2 ** ((column(0)[k] - 255 + cells.gainTop) / 4);
    const octave = column(1)[k];
    if (terms !== null && octave > 0) terms[p] = 2 ** (octave - 128);
    if (spheres === null) return;
    for (let axis = 0; axis < 3; axis++) spheres[4 * p + axis] = (column(each - 4 + axis)[k] - 128) / STEPS;
    spheres[4 * p + 3] = 2 ** ((column(each - 1)[k] - 128) / OCTAVE);
  });
  const glances = new Columns(data.subarray(data.length - 4 * sectors), sectors).next(4);
  return { gains, terms, middle, spheres, glances };
}

/** Return a row with all parts alike: what a cell is taken to see whose own row is lost. */
export function everything(scene: StaticScene): CellRow {
  return { gains: new Float32Array(scene.parts).fill(1), terms: null, middle: null, spheres: null, glances: new Uint32Array(0) };
}
