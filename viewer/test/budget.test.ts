// What is drawn where more is in view than a budget allows: measures, walls, counts, and that pictures do not flicker.
import assert from "node:assert/strict";
import { test } from "node:test";
import { Budget, type Content, ruler } from "../src/core/budget.ts";
import { axesOf, cameraOf, rotationOf } from "../src/core/camera.ts";
import { decodeRecord, tablesOf } from "../src/core/tables.ts";
import type { Camera, ColorTables } from "../src/core/types.ts";
import { QualityChoice } from "../src/page/quality.ts";

const TABLES = tablesOf({
  variant: "rgb", precision: { name: "wire", base: 8, scale: 8, axis: 6, center: 6, decay: 5, intensity: 6 },
  base: [[0, 1], [0, 1], [0, 1]], scales: [1, 1], decays: [1, 10], intensity: 1,
} satisfies ColorTables);
const AHEAD: [number, number, number, number] = [1, 0, 0, 0]; // along +z
const CAMERA = cameraOf({ position: [0, 0, 0], rotation: AHEAD }, 128, 128, 1.2);
const AREA = { left: -4, top: -4, right: 132, bottom: 132 };

interface Spot {
  at: [number, number, number];
  size: number; // log2 of a standard deviation
  opacity: number; // of 255
}

/** Return Gaussians in one chunk that spans 16 units around the origin, by rising depth or not. */
function scene(spots: readonly Spot[], turns: readonly number[] = [255, 255, 255]): Content {
  const records = new Uint32Array(4 << 16), chunks = Float32Array.of(-8, -8, -8, -640, 16 / 16383, 16 / 16383, 16 / 16383, 2);
  spots.forEach(({ at, size, opacity }, i) => {
    records[4 * i] = opacity;
    at.forEach((x, k) => {
      const place = Math.round((x + 8) / chunks[4]), scale = Math.round((64 * size + 640) / 2) + 3 * k * (turns[0] === 255 ? 0 : 1);
      records[4 * i + 1 + k] = ((scale << 23) | (turns[k] << 14) | place) >>> 0;
    });
  });
  return {
    hsl: false, count: spots.length, chunks, pages: [{ records, rows: new Uint32Array(1 << 16), means: null }],
  };
}

/** Return the places of spots, farthest first. */
function orderOf(spots: readonly Spot[]): Uint32Array {
  return Uint32Array.from(spots.keys()).sort((a, b) => spots[b].at[2] - spots[a].at[2]);
}

function choose(budget: Budget, spots: readonly Spot[], most: number, camera: Camera = CAMERA): number[] {
  const order = orderOf(spots);
  return [...order.subarray(0, budget.choose(scene(spots), order, spots.length, camera, AREA, most))];
}

/** Return spots of all sizes in front of the eye, the same in every run. */
function many(count: number): Spot[] {
  let state = 7;
  const next = (): number => (state = (Math.imul(state, 1664525) + 1013904223) >>> 0) / 2 ** 32;
  return Array.from({ length: count }, () => ({
    at: [3 * next() - 1.5, 3 * next() - 1.5, 3 + 4 * next()], size: -6 + 4 * next(), opacity: Math.floor(40 + 200 * next()),
  }));
}

test("a Gaussian measures as the projection of its covariance, with the blur or without", () => {
  const spots = many(50), turned = scene(spots, [300, 190, 420]), axes = axesOf(CAMERA), out = new Float64Array(3);
  for (const lowered of [false, true]) {
    const measure = ruler(turned, CAMERA, lowered, out);
    for (let i = 0; i < spots.length; i++) {
      measure(turned.pages[0], i);
      const { mean, quat, scale } = decodeRecord(turned.pages[0].records, i, turned.chunks, 0, TABLES);
      const [x, y, z] = [0, 3, 6].map((k) => axes[k] * mean[0] + axes[k + 1] * mean[1] + axes[k + 2] * mean[2]);
      const turn = rotationOf(quat), jacobian = [[CAMERA.fx / z, 0, -CAMERA.fx * x / z ** 2], [0, CAMERA.fy / z, -CAMERA.fy * y / z ** 2]];
      const half = jacobian.map((row) => [0, 1, 2].map((k) => scale[k] * [0, 1, 2].reduce(
        (sum, j) => sum + row[j] * (axes[3 * j] * turn[k] + axes[3 * j + 1] * turn[3 + k] + axes[3 * j + 2] * turn[6 + k]), 0)));
      const [xx, xy, yy] = [[0, 0], [0, 1], [1, 1]].map(([a, b]) => [0, 1, 2].reduce((sum, k) => sum + half[a][k] * half[b][k], 0));
      const blur = lowered ? 0 : 0.3, area = Math.sqrt((xx + blur) * (yy + blur) - xy * xy);
      assert.ok(Math.abs(out[0] - (CAMERA.fx * x / z + CAMERA.cx)) < 1e-3 && Math.abs(out[1] - (CAMERA.fy * y / z + CAMERA.cy)) < 1e-3);
      assert.ok(Math.abs(out[2] - area) < 1e-3 * area, `${out[2]} for ${area}`);
    }
  }
});

test("what stands behind a wall goes first, however large it is", () => {
  const wall: Spot[] = [], behind: Spot[] = [];
  for (let x = -40; x <= 40; x++) for (let y = -40; y <= 40; y++) for (let layer = 0; layer < 3; layer++) {
    wall.push({ at: [x / 20, y / 20, 3 + layer / 100], size: -4, opacity: 250 });
  }
  for (let x = -4; x <= 4; x++) for (let y = -4; y <= 4; y++) behind.push({ at: [x / 2, y / 2, 6], size: 0, opacity: 250 });
  const most = wall.length / 3, kept = choose(new Budget(), [...wall, ...behind], most);
  assert.deepEqual(kept.filter((place) => place >= wall.length), []);
  assert.ok(kept.length > 0.9 * most);
  const free = choose(new Budget(), [...wall.slice(0, 5), ...behind], behind.length);
  assert.ok(free.every((place) => place >= 5), "without a wall the large ones stay");
});

test("what lies around the picture and reaches into it stays, however much lies there", () => {
  const crowd = Array.from({ length: 3000 }, (): Spot => ({ at: [-7, 0, 3.05], size: -3, opacity: 250 }));
  const edge: Spot = { at: [-2.1, 0, 3.1], size: -1, opacity: 250 }, inside = many(2000);
  const kept = choose(new Budget(), [...crowd, edge, ...inside], 500);
  assert.ok(kept.includes(crowd.length));
});

test("no more than the budget lie in the picture, in the order that they had, and again the same", () => {
  const spots = many(5000), all = [...orderOf(spots)];
  for (const most of [1, 10, 500, 4000]) {
    const budget = new Budget(), kept = choose(budget, spots, most), places = new Set(kept);
    assert.deepEqual(kept, all.filter((place) => places.has(place)));
    const inside = kept.filter((place) => {
      const [x, y, z] = spots[place].at;
      return Math.abs(CAMERA.fx * x / z) < 63 && Math.abs(CAMERA.fy * y / z) < 63;
    });
    assert.ok(inside.length <= most && (most < 500 || inside.length > 0.7 * most), `${inside.length} of ${most}`);
    assert.deepEqual(choose(budget, spots, most), kept);
  }
  const kept = choose(new Budget(), spots, 5000);
  assert.equal(kept.length, 5000);
});

test("as the eye trembles, fewer come and go than without a memory", () => {
  const spots = many(5000);
  const changes = (made: () => Budget): number => {
    let sum = 0, before = new Set<number>();
    for (let step = 0; step < 12; step++) {
      const eye = cameraOf({ position: [step % 2 ? 0.005 : 0, 0, 0], rotation: AHEAD }, 128, 128, 1.2);
      const now = new Set(choose(made(), spots, 1000, eye));
      if (step > 1) sum += [...now].filter((place) => !before.has(place)).length;
      before = now;
    }
    return sum;
  };
  const one = new Budget(), steady = changes(() => one), forgetful = changes(() => new Budget());
  assert.ok(steady < 0.7 * forgetful, `${steady} and ${forgetful}`);
});

test("an automatic quality draws less while pictures come slowly, all at rest, and does not swing", () => {
  const viewer = { budget: Infinity, maxPixelRatio: Infinity }, quality = new QualityChoice("auto", null);
  let now = 0;
  const draw = (count: number, passed: number): void => { for (let k = 0; k < count; k++) quality.drawn((now += passed)); };
  quality.use(viewer);
  draw(50, 90);
  assert.equal(viewer.budget, Infinity, "pictures at rest, such as those of a scene that loads, say nothing");
  quality.move(true);
  draw(8, 90);
  assert.equal(viewer.budget, 1_000_000);
  draw(7, 90);
  assert.equal(viewer.budget, 500_000);
  draw(300, 16);
  assert.equal(viewer.budget, 500_000, "a step that was too slow is not tried again");
  quality.move(false);
  assert.deepEqual(viewer, { budget: Infinity, maxPixelRatio: Infinity });
  quality.choose("low");
  assert.equal(viewer.budget, 250_000);
  quality.choose("high", 1000);
  assert.deepEqual(viewer, { budget: 1000, maxPixelRatio: Infinity });
});
