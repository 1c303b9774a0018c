// What to fetch next of a static scene: the part with the most light in view for what it costs, in bytes and in delay.
// The rule is that of the streaming server's policy "utility" (gsvis.abr.policies); the factors are not. docs/static.md
// has one table of both and says why they differ; tests/export/test_factors.py compares it with the sources.
import { rotationOf } from "./camera.ts";
import type { CellRow } from "./static-cells.ts";
import type { Index } from "./static-index.ts";
import type { SetBlocks } from "./static-sets.ts";
import type { Pose, View } from "./types.ts";

const PERIPHERAL = 0.0003; // how what is out of view counts
const SEEN = 0.5; // how the light counts that pictures in the cell show, beside all light of a part
const NEAR = 0.25; // sides of a cell that a part is away at least
const TERMS = 0.003; // what terms are worth whose row does not say it, over the gain of their part
const SETS = 10; // squared change of color that counts as much as light which is missing

/** States of parts, and of their terms. */
export const NONE = 0, ASKED = 1, HELD = 2, LOST = 3;

/** A part to fetch, the terms of one, a block of sets of harmonics, or a glance. */
export interface Choice {
  kind: "part" | "terms" | "sets" | "glance";
  number: number;
}

export interface Holdings {
  part: Uint8Array; // (P) states
  terms: Uint8Array; // (P) states
  sets: Uint8Array; // states of blocks
  glance: Uint8Array; // states, of all sectors of the first cell, then of the next
  left: Float32Array; // (P) share of the light that is not here yet
}

/** Return five planes (normal, offset): points inside have a positive distance from all; see `FieldOfView.planes`. */
export function frustum(pose: Pose, view: View): Float64Array {
  const turn = rotationOf(pose.rotation);
  const widest = (89 * Math.PI) / 180, planes = new Float64Array(20);
  const sides = [[view.left, 0, 1], [view.right, 0, -1], [view.up, 1, 1], [view.down, 1, -1]] as const;
  for (let k = 0; k < 5; k++) {
    const local = [0, 0, 1];
    if (k < 4) {
      const [tangent, axis, sign] = sides[k], angle = Math.min(Math.atan(tangent), widest);
      local[axis] = sign * Math.cos(angle);
      local[2] = Math.sin(angle);
    }
    for (let row = 0; row < 3; row++) {
      const v = turn[3 * row] * local[0] + turn[3 * row + 1] * local[1] + turn[3 * row + 2] * local[2];
      planes[4 * k + row] = v;
      planes[4 * k + 3] -= v * pose.position[row];
    }
  }
  return planes;
}

/**
 * Return what each part is worth to an eye: its light in the cell, as much of it as is in view, corrected for how much
 * nearer the eye is than the middle of the cell. Of what the nearest cell does not see an eye outside of it sees the
 * more, the farther it is (gsvis.abr.outside).
 */
export function worthOf(index: Index, row: CellRow, size: number, pose: Pose, view: View): Float32Array {
  const { middle } = row, { position } = pose, worth = new Float32Array(index.count), planes = frustum(pose, view);
  const away = middle ? Math.hypot(...middle.map((v, k) => Math.max(Math.abs(v - position[k]) / size - 0.5, 0))) : 0;
  const share = away < 1e-6 ? 0 : (away / (1 + away)) ** 2;
  for (let p = 0; p < index.count; p++) {
    const [x, y, z, radius] = sphereOf(index, row, p);
    const squared = (eye: readonly number[]): number => 1e-12 +
      Math.max((x - eye[0]) ** 2 + (y - eye[1]) ** 2 + (z - eye[2]) ** 2 + radius ** 2 / 4, (NEAR * size) ** 2);
    const light = row.gains[p] + (middle ? share * radius ** 2 / squared(middle) : 0);
    const near = (middle ? squared(middle) : 1) / squared(position);
    const seen = insideOf(planes, x, y, z, radius), all = row.spheres ? insideOf(planes, ...sphereOf(index, null, p)) : seen;
    worth[p] = light * near * (PERIPHERAL + (1 - PERIPHERAL) * (SEEN * seen + (1 - SEEN) * all));
  }
  return worth;
}

/** Return the sphere in which the light of a part is, center and radius: of what a cell sees, or of all of it. */
export function sphereOf({ spheres }: Index, row: CellRow | null, part: number): [number, number, number, number] {
  const [x, y, z, radius] = spheres.subarray(4 * part, 4 * part + 4);
  const [right, down, ahead, wider] = row?.spheres?.subarray(4 * part, 4 * part + 4) ?? [0, 0, 0, 1];
  return [x + right * radius, y + down * radius, z + ahead * radius, radius * wider];
}

/** Return the share of the light of a sphere that is in view, about: a normal distribution cut by the nearest border. */
export function insideOf(planes: Float64Array, x: number, y: number, z: number, radius: number): number {
  let depth = Infinity; // how far the center is inside of all borders
  for (let p = 0; p < 20; p += 4) {
    depth = Math.min(depth, planes[p] * x + planes[p + 1] * y + planes[p + 2] * z + planes[p + 3]);
  }
  const deviations = Math.sqrt(3) * depth / (radius || 1);
  return 1 / (1 + Math.exp(-deviations * (1.5976 + 0.07056 * deviations ** 2)));
}

/**
 * Return the part, the terms of a part that is here, or the block of sets with the most worth for its cost; null if
 * nothing of worth is left. A request costs its bytes, and `delay`, the bytes that its connection would carry in a
 * round trip. Sets change the light that is here.
 */
export function choose(
  index: Index, worth: Float32Array, ofTerms: Float32Array | null, held: Holdings, delay: number, blocks: SetBlocks,
): Choice | null {
  let best: Choice | null = null, most = 0, light = 0;
  for (let part = 0; part < index.count; part++) {
    if (worth[part] <= 0) continue;
    if (held.part[part] === HELD) light += worth[part];
    const mine = (worth[part] * held.left[part] ** 2 + 1e-30) / (index.bytes[part] + delay);
    if (held.part[part] === NONE && mine > most) [best, most] = [{ kind: "part", number: part }, mine];
    if (held.part[part] !== HELD || held.terms[part] !== NONE || index.termBytes[part] === 0) continue;
    const theirs = (ofTerms ? ofTerms[part] : worth[part] * TERMS) / (index.termBytes[part] + delay);
    if (theirs > most) [best, most] = [{ kind: "terms", number: part }, theirs];
  }
  const block = held.sets.indexOf(NONE);
  if (block < 0) return best;
  const value = (SETS * light * blocks.worth[block] + 1e-30) / (blocks.bytes[block] + delay);
  return value > most ? { kind: "sets", number: block } : best;
}
