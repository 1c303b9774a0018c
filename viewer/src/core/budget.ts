// Chooses what is drawn where more Gaussians are in view than a budget allows: those with the largest estimated weight.
// A weight is opacity times footprint times the light that is left in front of it. That light is kept for tiles of
// three sizes while everything is walked through from near to far: what stands behind a wall weighs nothing.
import { axesOf } from "./camera.ts";
import { LEAST_LOG, MOST_LOG } from "./tables.ts";
import type { Camera } from "./types.ts";

const PAGE_BITS = 16;
const SIDES = [1 / 240, 1 / 60, 1 / 15]; // of tiles, in widths of the picture
const KEPT = 2; // a Gaussian that was drawn counts this much more: pictures do not flicker
const BLUR = 0.3; // square pixels
const LARGEST = 1e15; // square pixels
const BINS = 1 << 13; // of weights: 32 in each octave of a float32
const BIN_SHIFT = 18;

/** What is chosen from: a scene as the sort Worker keeps it. */
export interface Content {
  readonly hsl: boolean;
  readonly count: number;
  readonly chunks: Float32Array;
  readonly pages: readonly { records: Uint32Array; rows: Uint32Array; means: Float32Array | null }[];
}

/** The part of the picture's plane that is drawn. */
export interface Area {
  left: number;
  top: number;
  right: number;
  bottom: number;
  lowered?: boolean; // opacities are lowered to make up for the blur
}

const scales = Float32Array.from({ length: MOST_LOG - LEAST_LOG + 1 }, (_, k) => 2 ** ((k + LEAST_LOG) / 64));
const weight = new Float32Array(1), bits = new Uint32Array(weight.buffer);

export class Budget {
  #shown = new Uint8Array(0); // of each place: it was drawn in the last picture
  #bins = new Uint16Array(0); // weight of each Gaussian of an order; its upper bit says that its center is in the picture

  /** Places mean something else from now on. */
  forget(): void {
    this.#shown = new Uint8Array(0);
  }

  /**
   * Keep in an order, farthest first, the `most` Gaussians in the picture with the largest weights, and those around it
   * that weigh as much. Returns how many are kept.
   */
  choose(scene: Content, order: Uint32Array, count: number, camera: Camera, area: Area, most: number): number {
    if (this.#bins.length < count) this.#bins = new Uint16Array(Math.ceil(1.1 * count));
    if (this.#shown.length < scene.count) {
      const shown = new Uint8Array(Math.ceil(1.25 * scene.count));
      shown.set(this.#shown);
      this.#shown = shown;
    }
    this.#weigh(scene, order, count, camera, area);
    const least = this.#threshold(count, most), bins = this.#bins, shown = this.#shown;
    let kept = 0;
    for (let k = 0; k < count; k++) {
      const place = order[k], stays = (bins[k] & (BINS - 1)) >= least;
      shown[place] = stays ? 1 : 0;
      if (stays) order[kept++] = place;
    }
    return kept;
  }

  /** Return the lowest bin from which on at most `most` Gaussians have their centers in the picture. */
  #threshold(count: number, most: number): number {
    const sizes = new Uint32Array(BINS), bins = this.#bins;
    for (let k = 0; k < count; k++) if (bins[k] & BINS) sizes[bins[k] & (BINS - 1)]++;
    let least = BINS, total = 0;
    while (least > 0 && total + sizes[least - 1] <= most) total += sizes[--least];
    return least;
  }

  /** Estimate the weights of an order, from near to far. */
  #weigh(scene: Content, order: Uint32Array, count: number, camera: Camera, area: Area): void {
    const { width, height } = camera, bins = this.#bins, shown = this.#shown;
    const grids = SIDES.map((share) => new Grid(share * width, area)), [fine, middle, coarse] = grids;
    const found = new Float64Array(3), measure = ruler(scene, camera, area.lowered ?? false, found);
    for (let k = count - 1; k >= 0; k--) {
      const place = order[k], page = scene.pages[place >>> PAGE_BITS], i = place & 0xffff;
      measure(page, i);
      const u = found[0], v = found[1], size = found[2], opacity = (page.records[4 * i] & 255) / 255;
      weight[0] = opacity * size * (shown[place] ? KEPT : 1);
      if (u >= area.left && v >= area.top && u < area.right && v < area.bottom) { // nothing is known of what is around
        const f = fine.tileAt(u, v), m = middle.tileAt(u, v), c = coarse.tileAt(u, v);
        weight[0] *= fine.light[f] * middle.light[m] * coarse.light[c];
        // a Gaussian takes light from a tile about as large as itself
        if (4 * size <= fine.area) fine.shade(f, opacity, size);
        else if (4 * size <= middle.area) middle.shade(m, opacity, size);
        else coarse.shade(c, opacity, size);
      }
      bins[k] = (bits[0] >>> BIN_SHIFT) | (u >= 0 && v >= 0 && u < width && v < height ? BINS : 0);
    }
  }
}

/** The light that is left in tiles of one size, 0 to 1. */
class Grid {
  readonly light: Float32Array;
  readonly area: number; // of a tile, square pixels
  readonly #column: number; // the first one; tiles lie the same whatever is around the picture
  readonly #row: number;
  readonly #columns: number;

  constructor(private readonly side: number, { left, top, right, bottom }: Area) {
    this.area = side * side;
    [this.#column, this.#row] = [Math.floor(left / side), Math.floor(top / side)];
    this.#columns = Math.floor(right / side) - this.#column + 1;
    this.light = new Float32Array(this.#columns * (Math.floor(bottom / side) - this.#row + 1)).fill(1);
  }

  /** Return the tile of a point in the area. */
  tileAt(u: number, v: number): number {
    return (Math.floor(v / this.side) - this.#row) * this.#columns + Math.floor(u / this.side) - this.#column;
  }

  shade(tile: number, opacity: number, size: number): void {
    this.light[tile] *= 1 - Math.min((2 * Math.PI * opacity * size) / this.area, 0.99 * opacity);
  }
}

/**
 * Return a function that measures Gaussians of a page: the center in pixels, and the product of the half axes of one
 * standard deviation, blurred as the rasterizer does (docs/conventions.md); it writes the three to `out`.
 */
export function ruler(
  { hsl, chunks }: Content, camera: Camera, lowered: boolean, out: Float64Array,
): (page: Content["pages"][number], i: number) => void {
  const { fx, fy, cx, cy, width, height } = camera, [ex, ey, ez] = camera.position, r = axesOf(camera);
  const slopeX = Math.max(cx, width - cx) / fx + (0.15 * width) / fx;
  const slopeY = Math.max(cy, height - cy) / fy + (0.15 * height) / fy;
  const half = hsl ? 127 : 255, turn = Math.SQRT1_2 / half;
  return ({ records, rows, means }, i) => {
    const c = 8 * rows[i], a = records[4 * i + 1], b = records[4 * i + 2], d = records[4 * i + 3];
    let x = 0, y = 0, z = 0, q1 = 0, q2 = 0, q3 = 0, s0 = 0, s1 = 0, s2 = 0;
    if (hsl) {
      [x, y, z] = [(a >>> 8) & 8191, (b >>> 5) & 8191, (d >>> 2) & 8191];
      [q1, q2, q3] = [(a >>> 21) & 255, (b >>> 18) & 255, (d >>> 15) & 255];
      [s0, s1, s2] = [((a >>> 29) | (b << 3)) & 255, ((b >>> 26) | (d << 6)) & 255, (d >>> 23) & 255];
    } else {
      [x, y, z] = [a & 16383, b & 16383, d & 16383];
      [q1, q2, q3] = [(a >>> 14) & 511, (b >>> 14) & 511, (d >>> 14) & 511];
      [s0, s1, s2] = [a >>> 23, b >>> 23, d >>> 23];
    }
    if (chunks[c + 4] < 0) [x, y, z] = [means![3 * i] - ex, means![3 * i + 1] - ey, means![3 * i + 2] - ez];
    else {
      x = chunks[c] - ex + x * chunks[c + 4];
      y = chunks[c + 1] - ey + y * chunks[c + 5];
      z = chunks[c + 2] - ez + z * chunks[c + 6];
    }
    const depth = r[6] * x + r[7] * y + r[8] * z;
    const slope = (r[0] * x + r[1] * y + r[2] * z) / depth, tilt = (r[3] * x + r[4] * y + r[5] * z) / depth;
    const bentX = Math.min(Math.max(slope, -slopeX), slopeX), bentY = Math.min(Math.max(tilt, -slopeY), slopeY);
    const px = fx / depth, py = fy / depth; // m, n: from the axes of the scene to pixels
    const m0 = px * (r[0] - bentX * r[6]), m1 = px * (r[1] - bentX * r[7]), m2 = px * (r[2] - bentX * r[8]);
    const n0 = py * (r[3] - bentY * r[6]), n1 = py * (r[4] - bentY * r[7]), n2 = py * (r[5] - bentY * r[8]);
    [q1, q2, q3] = [(q1 - half) * turn, (q2 - half) * turn, (q3 - half) * turn];
    const own = q1 * q1 + q2 * q2 + q3 * q3, q0 = Math.sqrt(Math.max(0, 1 - own)), twice = 2 / (q0 * q0 + own);
    const xx = twice * q1 * q1, yy = twice * q2 * q2, zz = twice * q3 * q3, xy = twice * q1 * q2, xz = twice * q1 * q3;
    const yz = twice * q2 * q3, wx = twice * q0 * q1, wy = twice * q0 * q2, wz = twice * q0 * q3;
    const low = chunks[c + 3], stride = chunks[c + 7];
    [s0, s1, s2] = [sizeOf(low + s0 * stride), sizeOf(low + s1 * stride), sizeOf(low + s2 * stride)];
    const a0 = s0 * (m0 * (1 - yy - zz) + m1 * (xy + wz) + m2 * (xz - wy));
    const a1 = s1 * (m0 * (xy - wz) + m1 * (1 - xx - zz) + m2 * (yz + wx));
    const a2 = s2 * (m0 * (xz + wy) + m1 * (yz - wx) + m2 * (1 - xx - yy));
    const b0 = s0 * (n0 * (1 - yy - zz) + n1 * (xy + wz) + n2 * (xz - wy));
    const b1 = s1 * (n0 * (xy - wz) + n1 * (1 - xx - zz) + n2 * (yz + wx));
    const b2 = s2 * (n0 * (xz + wy) + n1 * (yz - wx) + n2 * (1 - xx - yy));
    const o0 = a1 * b2 - a2 * b1, o1 = a2 * b0 - a0 * b2, o2 = a0 * b1 - a1 * b0, sharp = o0 * o0 + o1 * o1 + o2 * o2;
    const wide = a0 * a0 + a1 * a1 + a2 * a2 + b0 * b0 + b1 * b1 + b2 * b2;
    out[0] = fx * slope + cx;
    out[1] = fy * tilt + cy;
    const size = Math.sqrt(lowered ? sharp : sharp + BLUR * wide + BLUR * BLUR);
    out[2] = size < LARGEST ? size : 0; // as the shader draws it
  };
}

/** Return a standard deviation, in units of the scene. */
function sizeOf(log: number): number {
  return scales[Math.min(Math.max(log, LEAST_LOG), MOST_LOG) - LEAST_LOG];
}
