// Boxes of chunks, linear and logarithmic, and which rows have none.
import assert from "node:assert/strict";
import test from "node:test";
import { hasBox, writeBox } from "../src/core/boxes.ts";

function box(origin: number[], step: number[], bits: number): number[] {
  const boxes = new Float32Array(6);
  writeBox(Float32Array.of(...origin, 0, ...step, 1), 0, bits, boxes, 0);
  return [...boxes];
}

test("a box reaches from the first to the last place of each axis", () => {
  assert.deepEqual(box([-1, 0, 2], [0.5, 0.25, 0], 0x321), [-1, 0, 2, -0.5, 0.75, 2]);
  const [x, y, z, X, Y, Z] = box([-1, 0, 2], [-0.5, -0.25, -0.125], 0x321);
  [[x, 1 - Math.E], [y, 0], [z, Math.E ** 2 - 1], [X, 1 - Math.sqrt(Math.E)], [Y, Math.exp(0.75) - 1]].forEach(
    ([found, expected]) => assert.ok(Math.abs(found - expected) < 1e-6, `${found}, expected ${expected}`),
  );
  assert.ok(Math.abs(Z - Math.expm1(2.875)) < 1e-5);
});

test("rows that mean nothing have no box", () => {
  const has = (origin: number, step: number[], bits: number) =>
    hasBox(Float32Array.of(origin, 0, 0, 0, ...step, 1), 0, bits, 13);
  assert.ok(has(1, [0, 1, 2], 0xddd));
  assert.ok(has(1, [-0.1, -0.1, -0.1], 0x555));
  for (const [origin, step, bits] of [
    [NaN, [1, 1, 1], 0], [1, [1, Infinity, 1], 0], [1, [1, NaN, 1], 0], [1, [1, -1, 1], 0], [1, [-1, 0, -1], 0],
    [1, [1, 1, 1], 0xe00], [1, [1, 1, 1], 0x1ddd], [80, [-0.1, -0.1, -0.1], 0x777], [-89, [-1, -1, -1], 0],
  ] as [number, number[], number][]) assert.ok(!has(origin, step, bits), `${origin}, ${step}, ${bits}`);
});
