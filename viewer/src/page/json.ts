// Readers of JSON that somebody else has written: what is not as expected counts as absent.

import type { Vec3 } from "./vector.ts";

export type Fields = Record<string, unknown>;

/** Return the value if it is an object. */
export function fields(value: unknown): Fields | null {
  return typeof value === "object" && value !== null && !Array.isArray(value) ? (value as Fields) : null;
}

/** Return the first entries of a list; none of what is no list. */
export function list(value: unknown, most = Infinity): unknown[] {
  return Array.isArray(value) ? value.slice(0, most) : [];
}

/** Return a list of `count` finite numbers of at most `most`. */
export function numbers(value: unknown, count: number, most = Number.MAX_VALUE): number[] | null {
  if (!Array.isArray(value) || value.length !== count) return null;
  return value.every((x) => typeof x === "number" && Math.abs(x) <= most) ? (value as number[]) : null;
}

export function vector(value: unknown, most?: number): Vec3 | null {
  return numbers(value, 3, most) as Vec3 | null;
}

/** Whether a value is a finite number above 0. */
export function isPositive(value: unknown): value is number {
  return typeof value === "number" && Number.isFinite(value) && value > 0;
}
