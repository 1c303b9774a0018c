// The sort Worker's scene: order, culling, what comes later, what is replaced, and what lies under a pixel.
import assert from "node:assert/strict";
import test from "node:test";
import { writeBox } from "../src/core/boxes.ts";
import { axesOf, cameraOf, rotationOf, viewOf } from "../src/core/camera.ts";
import { alphaAt, pickAt } from "../src/core/picking.ts";
import { type Region, SortedScene } from "../src/core/sorting.ts";
import { decodeRecord, tablesOf } from "../src/core/tables.ts";
import type { Batch, Camera, ColorTables } from "../src/core/types.ts";

const COLORS: ColorTables = {
  variant: "rgb",
  precision: { name: "wire", base: 8, scale: 8, axis: 6, center: 6, decay: 5, intensity: 6 },
  base: [[0, 1], [0, 1], [0, 1]], scales: [1, 1], decays: [1, 10], intensity: 1,
};
const TABLES = tablesOf(COLORS);
const CAMERA = cameraOf({ position: [0.5, -0.2, -3], rotation: [0.96, 0.1, -0.2, 0.05] }, 120, 80, 0.9);

/** Even numbers in [0, 1), the same in every run. */
function numbers(seed: number): () => number {
  let state = seed;
  return () => {
    state = (Math.imul(state, 1664525) + 1013904223) >>> 0;
    return state / 2 ** 32;
  };
}

/** Return `count` Gaussians in chunks of 50 around the origin; of `curved`, every second is logarithmic. */
function randomBatch(count: number, first: number, firstRow: number, seed: number, curved = false): Batch {
  const next = numbers(seed), chunkCount = Math.ceil(count / 50);
  const chunks = new Float32Array(8 * chunkCount), records = new Uint32Array(4 * count), rows = new Uint32Array(count);
  for (let c = 0; c < chunkCount; c++) {
    const corner = [0, 1, 2].map(() => 12 * next() - 6), step = 0.5 / 16383;
    if (curved && c % 2) chunks.set([...corner.map((x) => x / 3), -300, -step, -step, -step, 1], 8 * c);
    else chunks.set([...corner, -300, step, step, step, 1], 8 * c);
  }
  for (let i = 0; i < count; i++) {
    rows[i] = firstRow + Math.floor(i / 50);
    const color = [0, 1, 2].reduce((bits, k) => bits | (Math.floor(256 * next()) << (8 * (k + 1))), 0);
    records[4 * i] = (color | Math.floor(40 + 215 * next())) >>> 0;
    for (let k = 1; k < 4; k++) {
      records[4 * i + k] = (
        (Math.floor(256 * next()) << 23) | (Math.floor(511 * next()) << 14) | Math.floor(16384 * next())
      ) >>> 0;
    }
  }
  const none = new Uint32Array(0), boxes = new Float32Array(6 * chunkCount);
  for (let c = 0; c < chunkCount; c++) writeBox(chunks, c, 0xeee, boxes, c);
  return {
    first, ids: Uint32Array.from({ length: count }, (_, i) => 1000 + first + i), records, rows,
    means: new Float32Array(0), firstRow, chunks, boxes,
    chunkLevels: Uint8Array.from({ length: 2 * chunkCount }, (_, k) => (k >> 1) % 3), firstTerm: 0, terms: none,
    owners: none,
    gone: none, labels: null,
  };
}

function regionOf(camera: Camera, slack = 0): Region {
  return { left: -slack, top: -slack, right: camera.width + slack, bottom: camera.height + slack, levels: 0xffff };
}

function splatAt(scene: SortedScene, place: number) {
  const page = scene.pages[place >> 16], i = place & 65535;
  return decodeRecord(page.records, i, scene.chunks, page.rows[i], TABLES);
}

function depthOf(scene: SortedScene, place: number, camera: Camera): number {
  const axes = axesOf(camera), { mean } = splatAt(scene, place);
  return [0, 1, 2].reduce((sum, k) => sum + axes[6 + k] * (mean[k] - camera.position[k]), 0);
}

/** Return the places that reach some pixel of a coarse grid. */
function reaching(scene: SortedScene, camera: Camera): Set<number> {
  const axes = axesOf(camera), found = new Set<number>();
  for (let place = 0; place < scene.count; place++) {
    const splat = splatAt(scene, place);
    for (let y = 0.5; y < camera.height; y += 8) {
      for (let x = 0.5; x < camera.width; x += 8) if (alphaAt(splat, camera, axes, x, y)) found.add(place);
    }
  }
  return found;
}

function sorted(scene: SortedScene, camera = CAMERA, slack = 0): number[] {
  const { order, count } = scene.sort(camera, regionOf(camera, slack), null);
  return [...order.subarray(0, count)];
}

for (const curved of [false, true]) test(`sorted is back to front, nothing seen is missing; curved: ${curved}`, () => {
  const scene = new SortedScene("rgb");
  scene.append(randomBatch(2000, 0, 0, 1, curved));
  const order = sorted(scene), inside = new Set(order);
  assert.equal(inside.size, order.length);
  assert.ok(order.length < 2000, "some chunks lie outside of the picture");
  for (let k = 1; k < order.length; k++) {
    const near = depthOf(scene, order[k], CAMERA), far = depthOf(scene, order[k - 1], CAMERA);
    assert.ok(far >= near * (1 - 1e-5) - 1e-6, `depth ${far} before ${near}`);
  }
  for (const place of reaching(scene, CAMERA)) assert.ok(inside.has(place));
});

test("what arrives later and what goes away gives the order of everything at once", () => {
  const parts = [randomBatch(300, 0, 0, 2, true), randomBatch(700, 300, 6, 3), randomBatch(64, 1000, 20, 4)];
  const whole = new SortedScene("rgb"), steps = new SortedScene("rgb");
  for (const part of parts) {
    steps.append({ ...part, gone: part.first === 1000 ? Uint32Array.of(5, 6, 400) : part.gone });
    sorted(steps);
    whole.append(part);
  }
  for (const slot of [5, 6, 400]) whole.remove(slot);
  assert.deepEqual(sorted(steps), sorted(whole));
  assert.equal(steps.gone, 3);
  assert.ok(!sorted(steps).includes(400));
});

test("a chunk that was out of view is found again when a wider Gaussian of it arrives", () => {
  const scene = new SortedScene("rgb"), batch = randomBatch(50, 0, 0, 5);
  batch.chunks.set([-4, 0, 0], 0);
  writeBox(batch.chunks, 0, 0xeee, batch.boxes, 0);
  for (let i = 0; i < 50; i++) for (let k = 1; k < 4; k++) batch.records[4 * i + k] &= (1 << 23) - 1;
  const camera = cameraOf({ position: [0, 0, -4], rotation: [1, 0, 0, 0] }, 100, 100, 0.5);
  scene.append(batch);
  assert.equal(sorted(scene, camera).length, 0);
  const wide = randomBatch(1, 50, 1, 6);
  wide.records[1] = (511 << 23) | (wide.records[1] & ((1 << 23) - 1));
  const none = new Float32Array(0);
  scene.append({ ...wide, chunks: none, boxes: none, chunkLevels: new Uint8Array(0), rows: Uint32Array.of(0) });
  assert.equal(sorted(scene, camera).length, 51);
});

test("levels that are not shown are left out", () => {
  const scene = new SortedScene("rgb");
  scene.append(randomBatch(600, 0, 0, 7));
  const all = sorted(scene, CAMERA, 1e6),
    { order, count } = scene.sort(CAMERA, { ...regionOf(CAMERA, 1e6), levels: 0b101 }, null);
  const some = [...order.subarray(0, count)];
  assert.deepEqual(some, all.filter((place) => Math.floor(place / 50) % 3 !== 1));
});

test("what is left after a compaction has the same slots, ids and order", () => {
  const scene = new SortedScene("rgb"), terms = Uint32Array.of(1, 0, 2, 0, 3, 0);
  scene.append({ ...randomBatch(500, 0, 0, 8, true), terms, owners: Uint32Array.of(3, 10, 499) });
  scene.append({ ...randomBatch(0, 500, 10, 9), gone: Uint32Array.from({ length: 200 }, (_, k) => 2 * k) });
  const before = sorted(scene).map((place) => scene.idAt(place));
  const { batches, slots } = scene.compact();
  assert.deepEqual(sorted(scene).map((place) => scene.idAt(place)), before);
  assert.equal(scene.count, 300);
  assert.equal(scene.termCount, 2);
  assert.equal(slots?.length, 300);
  assert.equal(slots[0], 1);
  assert.equal(scene.placeOf(0), -1);
  assert.equal(scene.idAt(scene.placeOf(499)), 1499);
  assert.equal(batches.reduce((sum, batch) => sum + batch.rows.length, 0), 300);
  assert.deepEqual(batches.flatMap((batch) => [...batch.owners]), [3, 499]);
  scene.append(randomBatch(10, 500, 10, 10));
  assert.equal(scene.idAt(scene.placeOf(505)), 1505);
  scene.remove(505);
  assert.equal(scene.gone, 1);
});

test("slots with a gap, where some did not fit into memory", () => {
  const scene = new SortedScene("rgb");
  scene.append(randomBatch(20, 0, 0, 11));
  scene.append(randomBatch(20, 100, 1, 12));
  assert.equal(scene.placeOf(19), 19);
  assert.equal(scene.placeOf(50), -1);
  assert.equal(scene.placeOf(101), 21);
});

test("a pixel's Gaussians are weighted front to back", () => {
  const scene = new SortedScene("rgb");
  scene.append(randomBatch(3000, 0, 0, 13));
  const axes = axesOf(CAMERA), x = 60.5, y = 40.5;
  const hits = [...Array(scene.count).keys()]
    .map((place) => ({ place, hit: alphaAt(splatAt(scene, place), CAMERA, axes, x, y) }))
    .flatMap(({ place, hit }) => (hit ? [{ place, ...hit }] : []))
    .sort((a, b) => a.depth - b.depth);
  let left = 1;
  const weights = hits.map(({ place, alpha }) => {
    const weight = left * alpha;
    left *= 1 - alpha;
    return { place, weight };
  });
  const best = weights.reduce((a, b) => (b.weight > a.weight ? b : a));
  const pick = pickAt(scene, TABLES, CAMERA, x, y, 0xffff);
  assert.ok(pick && hits.length > 3);
  assert.equal(pick.slot, best.place);
  assert.equal(pick.id, 1000 + best.place);
  assert.ok(Math.abs(pick.weight - best.weight) < 1e-9);
  assert.ok(pick.others.every((other) => other.weight <= pick.weight));
  assert.equal(pickAt(scene, TABLES, CAMERA, x, y, 0), null);
});

test("rotations are orthogonal, and a camera's view has its angles", () => {
  const r = rotationOf([2, 0.4, -1, 0.3]);
  for (let a = 0; a < 3; a++) {
    for (let b = 0; b < 3; b++) {
      const dot = [0, 1, 2].reduce((sum, k) => sum + r[3 * a + k] * r[3 * b + k], 0);
      assert.ok(Math.abs(dot - (a === b ? 1 : 0)) < 1e-12);
    }
  }
  const view = viewOf(cameraOf({ position: [0, 0, 0], rotation: [1, 0, 0, 0] }, 200, 100, Math.PI / 2));
  for (const [key, value] of Object.entries({ left: 2, right: 2, up: 1, down: 1 })) {
    assert.ok(Math.abs(view[key as keyof typeof view] - value) < 1e-12);
  }
});
