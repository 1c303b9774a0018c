// Readers of JSON that must be as expected; errors name the place, what was expected and what came.
import { ProtocolError } from "./wire.ts";

export type Fields = Record<string, unknown>;

export function refuse(where: string, expected: string, got: unknown): never {
  const text = (JSON.stringify(got) ?? "nothing").slice(0, 80);
  throw new ProtocolError(`${where}: expected ${expected}, got ${text}`);
}

export function object(value: unknown, where: string): Fields {
  if (typeof value !== "object" || value === null || Array.isArray(value)) {
    return refuse(where, "an object", typeof value);
  }
  return value as Fields;
}

export function number(value: unknown, low: number, high: number, where: string): number {
  if (typeof value !== "number" || !(value >= low && value <= high)) {
    return refuse(where, `a number from ${low} to ${high}`, value);
  }
  return value;
}

export function integer(o: Fields, key: string, low: number, high: number, where: string): number {
  const value = number(o[key], low, high, `${where}, ${key}`);
  return Number.isInteger(value) ? value : refuse(`${where}, ${key}`, "an integer", value);
}

export function list(o: Fields, key: string, least: number, most: number, where: string): unknown[] {
  const value = o[key];
  if (!Array.isArray(value)) return refuse(`${where}, ${key}`, "a list", typeof value);
  if (value.length < least || value.length > most) {
    refuse(`${where}, ${key}`, `${least} to ${most} entries`, value.length);
  }
  return value;
}

export function triple(value: unknown, where: string): [number, number, number] {
  if (!Array.isArray(value) || value.length !== 3) return refuse(where, "three numbers", value);
  const [x, y, z] = value.map((part) => number(part, -1e30, 1e30, where));
  return [x, y, z];
}
