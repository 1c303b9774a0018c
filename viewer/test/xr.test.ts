// The eyes of a headset as cameras of the scene.
import assert from "node:assert/strict";
import test from "node:test";
import { axesOf, cameraOf, rotationOf } from "../src/core/camera.ts";
import { frameAt, lensOf } from "../src/core/xr.ts";

const near = (found: number[], wanted: number[]) => found.forEach(
  (value, k) => assert.ok(Math.abs(value - wanted[k]) < 1e-6, `${found} for ${wanted}`),
);
const EYE = cameraOf({ position: [1, 2, 3], rotation: [0.5, 0.5, -0.5, 0.5] }, 100, 100, 1);
const VIEW = {
  projectionMatrix: Float32Array.of(1.2, 0, 0, 0, 0, 1.5, 0, 0, 0.1, -0.2, -1, -1, 0, 0, -0.02, 0),
  transform: { position: { x: 0, y: 0, z: 0 }, orientation: { x: 0, y: 0, z: 0, w: 1 } },
};

test("a head that looks ahead looks where the level part of the eye looked", () => {
  const r = rotationOf(EYE.rotation), up = [-r[1], -r[4], -r[7]];
  const lens = lensOf(VIEW, 200, 100, frameAt(EYE, up, 2));
  near(lens.position, EYE.position);
  near(axesOf(lens), axesOf(EYE));
});

test("a step of a meter to the right and up is that of the scene's units", () => {
  const r = rotationOf(EYE.rotation), up = [-r[1], -r[4], -r[7]];
  const moved = { ...VIEW, transform: { ...VIEW.transform, position: { x: 1, y: 0.5, z: -2 } } };
  const lens = lensOf(moved, 200, 100, frameAt(EYE, up, 0.5));
  const expected = [0, 1, 2].map((k) => EYE.position[k] + 2 * (r[3 * k] - 0.5 * r[3 * k + 1] + 2 * r[3 * k + 2]));
  near(lens.position, expected);
});

test("a point projects as the headset's own matrix says", () => {
  const lens = lensOf(VIEW, 200, 100, { rotation: [1, 0, 0, 0, 1, 0, 0, 0, 1], origin: [0, 0, 0], scale: 1 });
  const point = [0.3, -0.4, -2], p = VIEW.projectionMatrix; // of WebXR
  const x = (p[0] * point[0] + p[8] * point[2]) / -point[2], y = (p[5] * point[1] + p[9] * point[2]) / -point[2];
  const a = axesOf(lens),
    camera = [0, 1, 2].map((k) => a[3 * k] * point[0] + a[3 * k + 1] * point[1] + a[3 * k + 2] * point[2]);
  near(
    [(lens.fx * camera[0]) / camera[2] + lens.cx, (lens.fy * camera[1]) / camera[2] + lens.cy],
    [(x + 1) * 100, (1 - y) * 50],
  );
});

test("looking straight down, forward is where the top of the head points", () => {
  const down = {
    position: [0, 0, 0] as [number, number, number], rotation: [0, 1, 0, 0] as [number, number, number, number],
  };
  const r = rotationOf(down.rotation), up = [-r[2], -r[5], -r[8]];
  const frame = frameAt(down, up, 1), forward = [2, 5, 8].map((k) => -frame.rotation[k]);
  near(forward, [-r[1], -r[4], -r[7]]);
});
