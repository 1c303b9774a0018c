// Vectors, quaternions (wxyz) and the frame of a scene: which way is up, and two level axes that turns are counted
// from.

import { quaternionOf } from "../core/index.ts";

export type Vec3 = [number, number, number];
export type Quat = [number, number, number, number];

export const add = (a: Vec3, b: Vec3): Vec3 => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
export const subtract = (a: Vec3, b: Vec3): Vec3 => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
export const scale = (a: Vec3, s: number): Vec3 => [a[0] * s, a[1] * s, a[2] * s];
export const dot = (a: Vec3, b: Vec3): number => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const length = (a: Vec3): number => Math.hypot(a[0], a[1], a[2]);
export const distance = (a: Vec3, b: Vec3): number => length(subtract(a, b));
export const mix = (a: Vec3, b: Vec3, t: number): Vec3 => add(scale(a, 1 - t), scale(b, t));
export const clamp = (x: number, low: number, high: number): number => Math.min(Math.max(x, low), high);

/** Return the least and the largest value, of any number of values. */
export function boundsOf(values: readonly number[]): [number, number] {
  let [low, high] = [Infinity, -Infinity];
  for (const value of values) [low, high] = [Math.min(low, value), Math.max(high, value)];
  return [low, high];
}

export function cross(a: Vec3, b: Vec3): Vec3 {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}

/** Return `a` with length 1, or `otherwise` where it has none. */
export function normalize(a: Vec3, otherwise: Vec3 = [0, 0, 1]): Vec3 {
  const size = length(a);
  return size > 1e-12 && Number.isFinite(size) ? scale(a, 1 / size) : otherwise;
}

/** Rotate `v` by the quaternion `q` of any length above 0. */
export function rotate(q: Quat, v: Vec3): Vec3 {
  const [w, x, y, z] = q;
  const axis: Vec3 = [x, y, z];
  const twice = scale(cross(axis, v), 2 / (w * w + x * x + y * y + z * z));
  return add(add(v, scale(twice, w)), cross(axis, twice));
}

/**
 * Return the unit quaternion whose rotation has these columns, which are orthonormal and right-handed; its w is not
 * negative.
 */
export function quaternionFromColumns(a: Vec3, b: Vec3, c: Vec3): Quat {
  const [w, x, y, z] = quaternionOf([0, 1, 2].flatMap((k) => [a[k], b[k], c[k]]));
  return w < 0 ? [-w, -x, -y, -z] : [w, x, y, z];
}

/** Level axes of a scene: turning right leads from `north` to `east`. */
export interface Frame {
  up: Vec3;
  north: Vec3;
  east: Vec3;
}

/** Choose level axes for a scene: north is the axis after the one nearest to `up`, made level. */
export function frameFromUp(up: Vec3): Frame {
  const unit = normalize(up, [0, 0, 1]);
  const sizes = unit.map(Math.abs);
  const nearest = sizes.indexOf(Math.max(...sizes));
  const axis: Vec3 = [0, 0, 0];
  axis[(nearest + 1) % 3] = 1;
  const north = normalize(subtract(axis, scale(unit, dot(axis, unit))));
  return { up: unit, north, east: cross(north, unit) };
}
