// The parts of a static scene: how many Gaussians and bytes each has, and the sphere that it reaches.
import type { StaticScene } from "./static-scene.ts";
import { Columns, damaged, inflate } from "./static-tables.ts";

const WIDTH = 22; // bytes of a part
const STEPS = 64, OCTAVE = 4; // of places, and of radii

export class Index {
  readonly count: number;
  readonly sizes: Uint32Array; // Gaussians
  readonly bytes: Uint32Array; // of records
  readonly termBytes: Uint32Array;
  readonly spheres: Float32Array; // (4 P)
  readonly meanRadius: number;

  /** Read the content of `index`. */
  static async open(scene: StaticScene, data: Uint8Array): Promise<Index> {
    return new Index(scene, await inflate(data, WIDTH * scene.parts, "index"));
  }

  constructor({ parts, middle, scale, header }: StaticScene, data: Uint8Array) {
    if (data.length !== WIDTH * parts) throw damaged("index");
    const columns = new Columns(data, parts);
    this.count = parts;
    this.spheres = new Float32Array(4 * parts);
    for (let axis = 0; axis < 3; axis++) {
      columns.sums(3).forEach((place, k) => {
        this.spheres[4 * k + axis] = middle[axis] + scale * Math.sinh(place / STEPS);
      });
    }
    let sum = 0;
    columns.next(1).forEach((value, k) => {
      sum += this.spheres[4 * k + 3] = scale * 2 ** ((value - 128) / OCTAVE);
    });
    this.meanRadius = Math.max(sum / Math.max(parts, 1), 1e-9);
    this.sizes = columns.next(4);
    this.bytes = columns.next(4);
    this.termBytes = columns.next(4);
    if (this.sizes.reduce((total, size) => total + size, 0) !== header.gaussians) throw damaged("index");
  }
}
