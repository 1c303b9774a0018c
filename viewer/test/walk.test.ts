// Walking over voxels: walls stop and lead along, feet rise by steps and fall, nobody leaves the grid.

import assert from "node:assert/strict";
import { test } from "node:test";
import { NOTHING_HELD, Navigator } from "../src/page/navigator.ts";
import { rigFromTarget } from "../src/page/rig.ts";
import * as v from "../src/page/vector.ts";
import type { Vec3 } from "../src/page/vector.ts";
import { readWalk, WalkGround } from "../src/page/walk.ts";
import type { WalkGrid } from "../src/page/walk.ts";

const SIDE = 32, EYE = 1.6, SIZE = 0.1;
const AXES: WalkGrid["axes"][] = [
  [[1, 0, 0], [0, 1, 0], [0, 0, 1]], [[1, 0, 0], [0, 0, -1], [0, 1, 0]], [[0.6, 0.8, 0], [0, 0, 1], [0.8, -0.6, 0]],
];

/** Return a grid whose ground has a height for each column, open from there on; below 0 is solid. */
function gridOf(height: (x: number, y: number) => number, axes = AXES[0]): WalkGrid {
  const bits = new Uint8Array((SIDE ** 3) / 8);
  for (let z = 0; z < SIDE; z++) for (let y = 0; y < SIDE; y++) for (let x = 0; x < SIDE; x++) {
    const ground = height(x, y), at = x + SIDE * (y + SIDE * z);
    if (ground >= 0 && z >= ground) bits[at >> 3] |= 1 << (at & 7);
  }
  return { origin: [3, -2, 5], size: SIZE, axes, eye: EYE, step: 3, shape: [SIDE, SIDE, SIDE], bits };
}

const eyeAt = ({ origin, axes }: WalkGrid, x: number, y: number, z: number): Vec3 =>
  [x * SIZE, y * SIZE, z * SIZE + EYE].map((along, k) => v.scale(axes[k], along)).reduce(v.add, origin);
const placeOf = ({ origin, axes }: WalkGrid, eye: Vec3): number[] =>
  axes.map((axis, k) => (v.dot(v.subtract(eye, origin), axis) - (k === 2 ? EYE : 0)) / SIZE);
const near = (a: readonly number[], b: readonly number[]): void =>
  a.forEach((x, k) => assert.ok(Math.abs(x - b[k]) < 1e-6, `${a} is not ${b}`));

test("a wall stops who walks into it, and leads along who walks askew, in any frame", () => {
  for (const axes of AXES) {
    const grid = gridOf((x) => (x === 20 ? -1 : 0), axes), ground = new WalkGround(grid);
    const ahead = placeOf(grid, ground.step(eyeAt(grid, 10.5, 10.5, 0), eyeAt(grid, 31, 10.5, 0)));
    assert.ok(ahead[0] > 19.5 && ahead[0] < 20);
    const askew = placeOf(grid, ground.step(eyeAt(grid, 18.5, 5.5, 0), eyeAt(grid, 28.5, 15.5, 0)));
    assert.ok(askew[0] < 20 && askew[1] > 10);
    const straight = placeOf(grid, ground.straight(eyeAt(grid, 18.5, 5.5, 0), eyeAt(grid, 28.5, 15.5, 0)));
    assert.ok(Math.abs(straight[0] - straight[1] - 13) < 1e-6);
    const rim = placeOf(grid, ground.step(eyeAt(grid, 5.5, 5.5, 0), eyeAt(grid, -50, 5.5, 0)));
    assert.ok(rim[0] >= 0 && rim[0] < 0.5);
  }
});

test("feet rise by stairs, not by a table, and fall to the ground ever faster", () => {
  const stairs = gridOf((x) => 2 * Math.max(0, Math.floor((x - 8) / 3))), up = new WalkGround(stairs);
  const top = up.step(eyeAt(stairs, 4.5, 9.5, 0), eyeAt(stairs, 30.5, 9.5, 0));
  near(placeOf(stairs, top), [30.5, 9.5, 14]);
  const table = gridOf((x) => (x > 15 ? 7 : 0)), beside = new WalkGround(table);
  assert.ok(placeOf(table, beside.step(eyeAt(table, 10.5, 9.5, 0), eyeAt(table, 30.5, 9.5, 0)))[0] < 16);
  let eye = beside.step(eyeAt(table, 20.5, 9.5, 7), eyeAt(table, 10.5, 9.5, 7));
  near(placeOf(table, eye), [10.5, 9.5, 7]);
  const falls: number[] = [];
  for (let last: Vec3; last = eye, (eye = beside.fall(eye, 1 / 60)) !== last; ) falls.push(v.distance(eye, last));
  near(placeOf(table, eye), [10.5, 9.5, 0]);
  assert.ok(falls.length > 5 && falls[3] > falls[1]);
});

test("the nearest place to stand is on the ground of an open column", () => {
  const grid = gridOf((x, y) => (x < 16 ? -1 : y < 16 ? 4 : 0)), ground = new WalkGround(grid);
  near(placeOf(grid, ground.nearest(eyeAt(grid, 3.3, 4.4, 9))), [16.01, 4.4, 4]);
  const closed = gridOf(() => -1), nowhere = eyeAt(closed, 1, 1, 1);
  assert.equal(new WalkGround(closed).nearest(nowhere), nowhere);
});

test("held keys walk at the pace of a person, and never into what is solid", () => {
  const grid = gridOf((x, y) => (Math.hypot(x - 16, y - 16) < 6 ? -1 : 0)), frame = v.frameFromUp([0, 0, 1]);
  const start = eyeAt(grid, 2.5, 2.5, 0), navigator = new Navigator(frame, rigFromTarget(start, v.add(start, [1, 1, 0]), frame));
  [navigator.mode, navigator.calm] = ["walk", true];
  navigator.standOn(new WalkGround(grid));
  navigator.step(0.5, { ...NOTHING_HELD, ahead: 1 });
  assert.ok(Math.abs(v.distance(navigator.shown.eye, start) - 0.7) < 0.1);
  for (let k = 0; k < 600; k++) {
    navigator.step(k % 7 ? 1 / 60 : 0.2, { ...NOTHING_HELD, ahead: 1, turn: k % 90 < 20 ? 1 : 0, fast: k % 200 > 150 });
    const [x, y, z] = placeOf(grid, navigator.shown.eye);
    assert.ok(x >= 0 && y >= 0 && x < SIDE && y < SIDE && Math.hypot(Math.floor(x) - 16, Math.floor(y) - 16) >= 6);
    assert.ok(Math.abs(z) < 1e-6);
  }
});

test("a grid is read as it was packed; anything else is none", () => {
  const { bits, ...said } = gridOf((x) => x % 5);
  const packed = (fields: object, data = bits): Uint8Array => new Uint8Array(
    [...new TextEncoder().encode(`${JSON.stringify({ version: 1, ...fields })}\n`), ...data],
  );
  assert.deepEqual(readWalk(packed(said)), { ...said, bits });
  for (const wrong of [{ version: 2 }, { shape: [1, 2] }, { shape: [1e9, 1e9, 1e9] }, { size: 0 }, { axes: [[1, 0, 0]] }]) {
    assert.equal(readWalk(packed({ ...said, ...wrong })), null);
  }
  for (const data of [packed(said, bits.subarray(1)), new Uint8Array(0), new Uint8Array([123, 10])]) {
    assert.equal(readWalk(data), null);
  }
});
