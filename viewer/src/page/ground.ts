// Where a walker can be while walls are not known (walk.ts): on a plane, or over the floor of cells.

import { add, clamp, dot, scale, subtract } from "./vector.ts";
import type { Frame, Vec3 } from "./vector.ts";

export interface Ground {
  /** Return where a walker ends up that wants to go from one eye position to another. */
  step(from: Vec3, to: Vec3): Vec3;
  /** Return the nearest eye position at which a walker can stand. */
  nearest(eye: Vec3): Vec3;
  /** Return where a walker ends up that goes straight, until something is in the way. */
  straight?(from: Vec3, to: Vec3): Vec3;
  /** Return the eye after some seconds of falling; the same one on the ground. */
  fall?(eye: Vec3, seconds: number): Vec3;
  /** Height of the eye above the ground, scene units. */
  readonly eye?: number;
}

/** Keep the height at which walking began: nothing is known of the ground. */
export class LevelGround implements Ground {
  constructor(private readonly frame: Frame) {}

  step(from: Vec3, to: Vec3): Vec3 {
    return subtract(to, scale(this.frame.up, dot(subtract(to, from), this.frame.up)));
  }

  nearest(eye: Vec3): Vec3 {
    return eye;
  }
}

/** Heights of a walker's eye over a grid of level squares; NaN where nobody can stand. */
export interface Floor {
  origin: Vec3; // corner of square (0, 0), at height 0
  side: number; // of a square, scene units
  first: Vec3; // unit axis along a row
  second: Vec3; // unit axis from row to row
  up: Vec3; // unit axis of the heights
  columns: number;
  rows: number;
  heights: Float32Array; // (columns x rows), row after row, scene units from the origin along up
}

/** Return `x` if it lies in a square, else the nearest place well inside. */
export const inside = (x: number, square: number): number => (x >= square && x < square + 1 ? x : clamp(
  x, square + 0.01, square + 0.99,
));

const MOST_STEP = 0.5; // of a square: what is thinner than a square still stops a walker

/** Walk over a floor: slide along what blocks, climb at most `climb` scene units from square to square. */
export class FloorGround implements Ground {
  constructor(
    private readonly floor: Floor,
    private readonly climb: number,
  ) {}

  step(from: Vec3, to: Vec3): Vec3 {
    let at = from;
    const whole = this.#place(subtract(to, from));
    const pieces = clamp(Math.ceil(Math.hypot(whole[0], whole[1]) / MOST_STEP), 1, 256);
    const [first, second] = [whole[0] / pieces, whole[1] / pieces];
    for (let piece = 0; piece < pieces; piece++) {
      at = this.#move(at, first, second) ?? this.#move(at, first, 0) ?? this.#move(at, 0, second) ?? at;
    }
    return at;
  }

  nearest(eye: Vec3): Vec3 {
    const { columns, rows, heights } = this.floor;
    const [x, y, height] = this.#locate(eye);
    let best = Infinity;
    let found: Vec3 | null = null;
    for (let row = 0; row < rows; row++) {
      for (let column = 0; column < columns; column++) {
        const level = heights[row * columns + column];
        if (!Number.isFinite(level)) continue;
        const square: [number, number] = [inside(x, column), inside(y, row)];
        const away = Math.hypot(square[0] - x, square[1] - y, (level - height) / this.floor.side);
        if (away < best) {
          best = away;
          found = this.#position(square[0], square[1], level);
        }
      }
    }
    return found ?? eye;
  }

  /** Return the eye after a small step in squares, or null where nobody can stand. */
  #move(at: Vec3, first: number, second: number): Vec3 | null {
    const [x, y, height] = this.#locate(at);
    const level = this.#height(x + first, y + second);
    const here = this.#height(x, y);
    if (!Number.isFinite(level)) return null;
    if (Number.isFinite(here) && Math.abs(level - here) > this.climb) return null;
    if (first === 0 && second === 0) return at;
    return this.#position(x + first, y + second, Number.isFinite(here) ? level : height);
  }

  #height(x: number, y: number): number {
    const { columns, rows, heights } = this.floor;
    const [column, row] = [Math.floor(x), Math.floor(y)];
    if (column < 0 || row < 0 || column >= columns || row >= rows) return NaN;
    return heights[row * columns + column];
  }

  /** Return squares along both axes and the height. */
  #locate(eye: Vec3): Vec3 {
    const offset = subtract(eye, this.floor.origin);
    const [x, y] = this.#place(offset);
    return [x, y, dot(offset, this.floor.up)];
  }

  #place(offset: Vec3): [number, number] {
    return [dot(offset, this.floor.first) / this.floor.side, dot(offset, this.floor.second) / this.floor.side];
  }

  #position(x: number, y: number, height: number): Vec3 {
    const { origin, side, first, second, up } = this.floor;
    return add(add(origin, scale(first, x * side)), add(scale(second, y * side), scale(up, height)));
  }
}
