// Where a walker's feet can be: voxels in which a body fits (gsvis/pvs/walk.py). Walls stop, feet rise by steps and fall
// to the ground, and beyond the grid nobody goes. Knows no browser; lengths are voxels inside, scene units outside.

import { inside } from "./ground.ts";
import type { Ground } from "./ground.ts";
import { fields, isPositive, vector } from "./json.ts";
import { dot, subtract } from "./vector.ts";
import type { Vec3 } from "./vector.ts";

export interface WalkGrid {
  origin: Vec3;
  size: number; // of a voxel
  axes: [Vec3, Vec3, Vec3]; // the last one points upwards
  eye: number; // above the feet, scene units
  step: number; // voxels that feet rise at once
  shape: Vec3;
  bits: Uint8Array; // x fastest, then y
}

const MOST_VOXELS = 1 << 28;
const NOTHING = 1e-6; // voxels: what is lost by rounding
const PIECE = 0.4; // voxels that are walked at once
const MOST_PIECES = 4096;
const ASIDE = [0, 0.25, -0.25, 0.5, -0.5, 0.75, -0.75, 1, -1, 1.25, -1.25]; // radians from the wish, along walls
const GRAVITY = 6.1; // eye heights a second a second: 9.8 m for an eye at 1.6 m

/** Read a grid, unpacked: a line of JSON and a bit for each voxel; null where it is none. */
export function readWalk(data: Uint8Array): WalkGrid | null {
  const end = data.indexOf(10);
  let said: ReturnType<typeof fields>;
  try {
    said = fields(JSON.parse(new TextDecoder().decode(data.subarray(0, Math.max(end, 0)))));
  } catch {
    return null;
  }
  const origin = vector(said?.origin), shape = vector(said?.shape), { size, eye, step, axes } = said ?? {};
  const rows = Array.isArray(axes) && axes.length === 3 ? axes.map((axis) => vector(axis)) : [null];
  if (said?.version !== 1 || !origin || !shape || !isPositive(size) || !isPositive(eye) || !isPositive(step)) return null;
  const bits = data.subarray(end + 1), count = shape[0] * shape[1] * shape[2];
  if (rows.includes(null) || !shape.every((n) => isPositive(n) && Number.isInteger(n))) return null;
  return count > MOST_VOXELS || bits.length < count / 8 ? null : { origin, size, axes: rows as WalkGrid["axes"], eye, step, shape, bits };
}

/** Walk over a grid: slide along walls, rise by steps, fall. Feet are in voxels, the third number upwards. */
export class WalkGround implements Ground {
  readonly eye: number;
  #speed = 0; // of a fall, voxels a second

  constructor(private readonly grid: WalkGrid) {
    this.eye = grid.eye;
  }

  step(from: Vec3, to: Vec3): Vec3 {
    return this.#go(from, to, ASIDE);
  }

  straight(from: Vec3, to: Vec3): Vec3 {
    return this.#go(from, to, [0]);
  }

  fall(eye: Vec3, seconds: number): Vec3 {
    const [x, y, z] = this.#feet(eye), inside = this.#rise(x, y, z, 0);
    if (inside === null) return eye;
    let ground = inside;
    while (this.#isOpen(x, y, ground - 1)) ground--;
    this.#speed = z > ground ? this.#speed + (GRAVITY * this.eye * seconds) / this.grid.size : 0;
    const next = Math.max(ground, z - this.#speed * seconds);
    return Math.abs(next - z) < NOTHING ? eye : this.#eyeOf([x, y, next]);
  }

  nearest(eye: Vec3): Vec3 {
    const { shape } = this.grid, [x, y, z] = this.#feet(eye);
    let best = Infinity, found: Vec3 | null = null;
    for (let k = 0; k < shape[2]; k++) {
      for (let j = 0; j < shape[1]; j++) {
        for (let i = 0; i < shape[0]; i++) {
          if (!this.#isOpen(i, j, k) || this.#isOpen(i, j, k - 1)) continue;
          const [a, b] = [inside(x, i), inside(y, j)], away = Math.hypot(a - x, b - y, k - z);
          if (away < best) [best, found] = [away, [a, b, k]];
        }
      }
    }
    return found ? this.#eyeOf(found) : eye;
  }

  /** Go towards an eye position, level, in pieces; what stops is passed at one of these angles, or ends the way. */
  #go(from: Vec3, to: Vec3, angles: readonly number[]): Vec3 {
    let at = this.#feet(from);
    const goal = this.#feet(to), [x, y] = [goal[0] - at[0], goal[1] - at[1]];
    const pieces = Math.ceil(Math.hypot(x, y) / PIECE);
    for (let piece = 0; piece < Math.min(pieces, MOST_PIECES); piece++) {
      const next = this.#pass(at, x / pieces, y / pieces, angles);
      if (!next) break;
      at = next;
    }
    return pieces ? this.#eyeOf(at) : from;
  }

  /** Return the feet after a piece of the way, at the first angle that is free; null where all are blocked. */
  #pass(at: Vec3, x: number, y: number, angles: readonly number[]): Vec3 | null {
    for (const angle of angles) {
      const [ahead, aside] = [Math.cos(angle) ** 2, Math.cos(angle) * Math.sin(angle)]; // what is left of a push
      const [i, j] = [at[0] + x * ahead - y * aside, at[1] + y * ahead + x * aside];
      const z = this.#rise(i, j, at[2], this.grid.step);
      if (z !== null && (z <= at[2] || this.#isOpen(at[0], at[1], z))) return [i, j, Math.max(z, at[2])];
    }
    return null;
  }

  /** Return the lowest open voxel from that of the feet up, at most some voxels higher; null if there is none. */
  #rise(x: number, y: number, z: number, most: number): number | null {
    const start = Math.floor(z + NOTHING);
    for (let k = start; k <= start + most; k++) if (this.#isOpen(x, y, k)) return k;
    return null;
  }

  #isOpen(x: number, y: number, z: number): boolean {
    const { shape, bits } = this.grid, [i, j] = [Math.floor(x), Math.floor(y)];
    if (i < 0 || j < 0 || z < 0 || i >= shape[0] || j >= shape[1] || z >= shape[2]) return false;
    const at = i + shape[0] * (j + shape[1] * z);
    return (bits[at >> 3] >> (at & 7) & 1) === 1;
  }

  #feet(eye: Vec3): Vec3 {
    const { origin, axes, size } = this.grid, offset = subtract(eye, origin);
    return [dot(offset, axes[0]) / size, dot(offset, axes[1]) / size, (dot(offset, axes[2]) - this.eye) / size];
  }

  #eyeOf([x, y, z]: Vec3): Vec3 {
    const { origin, axes, size } = this.grid;
    return [0, 1, 2].map(
      (k) => origin[k] + size * (x * axes[0][k] + y * axes[1][k]) + (size * z + this.eye) * axes[2][k],
    ) as Vec3;
  }
}
