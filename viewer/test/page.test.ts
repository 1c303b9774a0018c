// The page's geometry and texts: cameras, ways to move, views in addresses and settings.

import assert from "node:assert/strict";
import { test } from "node:test";
import { quaternionOf, rotationOf } from "../src/core/index.ts";
import { formatBytes, formatCount, formatLength, formatSeconds, formatShare } from "../src/page/format.ts";
import { FloorGround, LevelGround } from "../src/page/ground.ts";
import { fovOf } from "../src/page/begin.ts";
import { readHash, readUp, writeHash } from "../src/page/hash.ts";
import { NOTHING_HELD, Navigator } from "../src/page/navigator.ts";
import { project } from "../src/page/project.ts";
import * as rigs from "../src/page/rig.ts";
import { readSettings } from "../src/page/settings.ts";
import { along, readTour } from "../src/page/tour.ts";
import type { Tour } from "../src/page/tour.ts";
import * as v from "../src/page/vector.ts";
import type { Vec3 } from "../src/page/vector.ts";

const UPS: Vec3[] = [[0, 0, 1], [0, -1, 0], [0, 1, 0], [1, 0, 0], [0.2, -0.9, 0.3]];
const near = (a: readonly number[], b: readonly number[], tolerance = 1e-9): void =>
  a.forEach((x, i) => assert.ok(Math.abs(x - b[i]) < tolerance, `${a} is not ${b}`));
const sample = (): rigs.Rig => ({ eye: [1, 2, 3], turn: 0.7, tilt: -0.4, reach: 2.5, fovY: 1 });

test("frames are right-handed and level for any up", () => {
  for (const up of UPS) {
    const frame = v.frameFromUp(up);
    near(v.cross(frame.north, frame.up), frame.east);
    near([v.dot(frame.north, frame.up), v.length(frame.north), v.length(frame.up)], [0, 1, 1]);
  }
  near(v.frameFromUp([0, 0, 0]).up, [0, 0, 1]);
});

test("the camera looks ahead, without roll, right way up", () => {
  for (const up of UPS) {
    const frame = v.frameFromUp(up);
    for (const [turn, tilt] of [[0, 0], [0.7, -0.4], [3.1, 1.5], [-2, -1.5]]) {
      const rig = { ...sample(), turn, tilt };
      const q = rigs.rotation(rig, frame);
      near(v.rotate(q, [0, 0, 1]), rigs.forward(rig, frame));
      near([v.dot(v.rotate(q, [1, 0, 0]), frame.up)], [0]);
      assert.ok(v.dot(v.rotate(q, [0, -1, 0]), frame.up) > 0);
      const again = rigs.rigFromPose(rig.eye, q, frame, rig.reach, rig.fovY);
      near([again.tilt, rigs.wrap(again.turn - turn)], [tilt, 0], 1e-6);
    }
  }
});

test("a camera that looks straight down keeps its turn", () => {
  const frame = v.frameFromUp([0, 0, 1]);
  const rig = { ...sample(), tilt: -Math.PI / 2 };
  const q = rigs.rotation(rig, frame);
  const again = rigs.rigFromPose(rig.eye, q, frame, 1);
  near([rigs.wrap(again.turn - rig.turn), again.tilt], [0, -rigs.MOST_TILT], 1e-6);
});

test("turning right moves the view to the right, turns go the shorter way", () => {
  const frame = v.frameFromUp([0, 0, 1]);
  const rig = sample();
  const turned = rigs.look(rig, 0.1, 0);
  assert.ok(v.dot(rigs.forward(turned, frame), rigs.right(rig, frame)) > 0);
  const middle = rigs.between({ ...rig, turn: 3.1 }, { ...rig, turn: -3.1 }, 0.5);
  near([Math.abs(rigs.wrap(middle.turn))], [Math.PI]);
});

test("orbits keep the pivot and the distance; approaching keeps the pivot", () => {
  for (const up of UPS) {
    const frame = v.frameFromUp(up);
    const rig = sample();
    const turned = rigs.orbit(rig, frame, 1.2, 0.9);
    near(rigs.pivot(turned, frame), rigs.pivot(rig, frame));
    near([v.distance(turned.eye, rigs.pivot(rig, frame))], [rig.reach]);
    near(rigs.pivot(rigs.approach(rig, frame, 0.5), frame), rigs.pivot(rig, frame));
    near(rigs.pivot(rigs.aroundBetween(rig, turned, 0.3, frame), frame), rigs.pivot(rig, frame));
  }
});

test("walking stays level whatever the tilt", () => {
  for (const up of UPS) {
    const frame = v.frameFromUp(up);
    const rig = { ...sample(), tilt: -1 };
    const moved = v.subtract(rigs.walk(rig, frame, 1, 0, 2).eye, rig.eye);
    near([v.dot(moved, frame.up), v.length(moved)], [0, Math.sqrt(5)]);
  }
});

test("the navigator settles where it is wanted, in any steps of time", () => {
  for (const mode of ["orbit", "fly", "walk"] as const) {
    const ends = [0.001, 0.016, 0.3].map((seconds) => {
      const navigator = new Navigator(v.frameFromUp([0, 0, 1]), sample());
      navigator.setMode(mode);
      for (let i = 0; i < 2000 && navigator.step(0.5); i++);
      navigator.drag(0.5, 0.2);
      navigator.zoom(0.8);
      let steps = 0;
      while (navigator.step(seconds)) assert.ok(++steps < 5000);
      return navigator.shown;
    });
    for (const end of ends) near(end.eye, ends[0].eye, 1e-9);
    assert.ok(Math.abs(ends[0].turn - 1.2) < 1e-9);
  }
});

test("another frame keeps eye and target, also once the view has settled", () => {
  const navigator = new Navigator(v.frameFromUp([0, 0, 1]), sample());
  const before = rigs.pivot(navigator.shown, navigator.frame), { eye } = navigator.shown;
  navigator.reframe(v.frameFromUp([0, -1, 0]));
  for (let k = 0; k < 100; k++) navigator.step(0.05);
  assert.ok(v.distance(navigator.shown.eye, eye) < 1e-9);
  assert.ok(v.distance(rigs.pivot(navigator.shown, navigator.frame), before) < 1e-6);
});

test("flights end exactly at the view, and any drag takes over", () => {
  const frame = v.frameFromUp([0, -1, 0]);
  const navigator = new Navigator(frame, sample());
  const target = { ...sample(), eye: [9, 9, 9] as Vec3, turn: 2 };
  navigator.flyTo(target);
  navigator.step(0.3);
  assert.notDeepEqual(navigator.shown, target);
  navigator.step(5);
  assert.equal(navigator.shown, target);
  navigator.flyTo(sample());
  navigator.step(0.3);
  const there = navigator.shown.eye;
  navigator.drag(0, 0);
  for (let i = 0; i < 100; i++) navigator.step(0.1);
  near(navigator.shown.eye, there, 1e-3);
  navigator.calm = true;
  navigator.flyTo(target);
  assert.equal(navigator.shown, target);
});

test("held keys move by seconds, not by frames; diagonals are not faster", () => {
  const move = (held: object, steps: number): number => {
    const navigator = new Navigator(v.frameFromUp([0, 0, 1]), sample(), 2);
    navigator.setMode("fly");
    for (let i = 0; i < steps; i++) navigator.step(1 / steps, { ...NOTHING_HELD, ...held });
    for (let i = 0; i < 100; i++) navigator.step(0.1);
    return v.distance(navigator.shown.eye, sample().eye);
  };
  near([move({ ahead: 1 }, 10), move({ ahead: 1 }, 100)], [5, 5], 1e-6);
  near([move({ ahead: 1, aside: 1 }, 10)], [5], 1e-6);
  near([move({ ahead: 1, fast: true }, 10)], [15], 1e-6);
});

/**
 * A corridor of 6 x 3 squares with a wall between columns 2 and 4, open at the last row, and a step of 0.1 at the last
 * column.
 */
const corridor = (): FloorGround => {
  const heights = new Float32Array(18).fill(1.6);
  heights[3] = heights[9] = NaN;
  for (const i of [5, 11, 17]) heights[i] = 1.7;
  return new FloorGround({
    origin: [0, 0, 0], side: 0.5, first: [1, 0, 0], second: [0, 1, 0], up: [0, 0, 1], columns: 6, rows: 3, heights,
  }, 0.3);
};

test("walkers stop at walls, slide along them, climb steps, and never leave the floor", () => {
  const ground = corridor();
  const stopped = ground.step([1.2, 0.25, 1.6], [2.4, 0.25, 1.6]);
  assert.ok(stopped[0] < 1.5 && stopped[0] > 1.2);
  const slid = ground.step([1.45, 0.25, 1.6], [1.75, 0.65, 1.6]);
  assert.ok(slid[1] > 0.5 && slid[0] < 1.5);
  const through = ground.step([1.2, 1.25, 1.6], [2.8, 1.25, 1.6]);
  near(through, [2.8, 1.25, 1.7], 1e-6);
  const out = ground.step([0.2, 0.2, 1.6], [-50, 0.2, 1.6]);
  assert.ok(out[0] >= 0);
});

test("a walker begins at the nearest place to stand, a tall step stops", () => {
  const ground = corridor();
  const start = ground.nearest([1.74, 0.6, 9]);
  assert.ok(start[0] > 2 && start[2] > 1.5);
  const low = new FloorGround({
    origin: [0, 0, 0], side: 1, first: [1, 0, 0], second: [0, 1, 0], up: [0, 0, 1], columns: 2, rows: 1,
    heights: new Float32Array([1.6, 3]),
  }, 0.5);
  assert.ok(low.step([0.5, 0.5, 1.6], [1.5, 0.5, 1.6])[0] < 1);
});

test("without a floor walking keeps its height", () => {
  for (const up of UPS) {
    const frame = v.frameFromUp(up);
    const moved = new LevelGround(frame).step([1, 1, 1], [4, 5, 6]);
    near([v.dot(moved, frame.up)], [v.dot([1, 1, 1], frame.up)]);
  }
});

test("views in addresses come back", () => {
  for (const up of UPS) {
    const frame = v.frameFromUp(up);
    for (const reach of [0.01, 2.5, 300]) {
      const rig = { ...sample(), reach };
      const view = readHash(writeHash(rig, frame, "walk"));
      assert.ok(view && !(view instanceof Error));
      const again = rigs.rigFromTarget(view.eye, view.to, frame, (view.fov * Math.PI) / 180);
      near([again.turn, again.tilt], [rig.turn, rig.tilt], 1e-3);
      near(again.eye, rig.eye, 1e-4 * reach + 1e-9);
      assert.equal(view.mode, "walk");
    }
  }
});

test("an address without a view gives null, one with nonsense an Error", () => {
  for (const hash of ["", "#", "#help", "#x=1"]) assert.equal(readHash(hash), null);
  for (const hash of ["#eye=1,2,3", "#eye=1,2&to=1,2,3", "#eye=a,b,c&to=1,2,3", "#eye=1,2,3&to=1,2,3",
    "#eye=1e9,0,0&to=0,0,0",
    "#eye=Infinity,0,0&to=0,0,0", "#eye=,,&to=1,1,1"]) assert.ok(readHash(hash) instanceof Error, hash);
  const view = readHash("#eye=1,2,3&to=3,2,1&fov=900&mode=swim");
  assert.deepEqual(view, { eye: [1, 2, 3], to: [3, 2, 1], fov: 120 });
});

test("settings of both versions, other frames, and bad ones", () => {
  const pose = { position: [1, 2, 3], target: [4, 5, 6], fov: 75 };
  const one = readSettings(
    { camera: { ...pose, startAnim: "none" }, background: { color: [0.1, 0.2, 3] }, animTracks: [] }
  );
  assert.deepEqual(one, { views: [{ eye: [-1, -2, 3], to: [-4, -5, 6], fov: 75, longer: true }], background: [0.1, 0.2, 1], spots: false, animated: false, plays: false });
  const two = readSettings({
    version: 2, frame: "scene", cameras: [{ initial: pose }, { initial: { position: [1, 2] } }],
    annotations: [{ title: " <b>Door</b> ", camera: { initial: pose } }, 7], background: {},
  });
  assert.deepEqual(two.views.map((view) => view.name), [undefined, "<b>Door</b>"]);
  assert.deepEqual(two.views[0].eye, [1, 2, 3]);
  for (const bad of [null, 3, [], { version: 3 }]) assert.throws(() => readSettings(bad), /^Error: Expected (a JSON object|version 1 or 2)/);
  assert.deepEqual(readSettings({}), { views: [], background: null, spots: false, animated: false, plays: false });
  for (const said of [{ version: 2, startMode: "animTrack" }, { camera: { startAnim: "animTrack" } }]) {
    assert.deepEqual([readSettings(said).animated, readSettings(said).plays], [false, true]);
    assert.equal(readSettings({ ...said, animTracks: [{}] }).animated, true);
  }
});

test("angles of SuperSplat cover the longer side; others are of the height, and narrow windows see no less than 40 degrees", () => {
  const own = globalThis as { innerWidth?: number; innerHeight?: number };
  const across = (fovY: number): number => 2 * Math.atan(Math.tan(fovY / 2) * (own.innerWidth! / own.innerHeight!));
  for (const [width, height, fov, longer, tall, wide] of [
    [1600, 900, 75, true, null, 75], [900, 1600, 75, true, 75, null], [1600, 900, 60, false, 60, null],
    [390, 844, 60, false, null, 40], [390, 844, 20, false, null, 20], [390, 844, 90, false, 90, null],
  ] as const) {
    [own.innerWidth, own.innerHeight] = [width, height];
    const found = fovOf({ fov, longer });
    near([(tall === null ? across(found) : found) / rigs.DEGREES], [tall ?? wide]);
  }
  delete own.innerWidth;
  delete own.innerHeight;
});

/** Return where SuperSplat's viewer draws a point of its frame: a camera of PlayCanvas that looks along -z, up is +y. */
function drawnBySuperSplat(pose: { position: Vec3; target: Vec3; fov: number }, point: Vec3, width: number, height: number): Vec3 {
  const back = v.normalize(v.subtract(pose.position, pose.target));
  const right = v.normalize(v.cross([0, 1, 0], back)), above = v.cross(back, right);
  const offset = v.subtract(point, pose.position), depth = -v.dot(offset, back), aspect = width / height;
  const half = Math.tan((pose.fov * rigs.DEGREES) / 2); // `horizontalFov` is set in windows that are wider than high
  const [x, y] = width > height ? [half, half / aspect] : [half * aspect, half];
  const [left, up] = [v.dot(offset, right) / (depth * x), v.dot(offset, above) / (depth * y)];
  return [(width / 2) * (1 + left), (height / 2) * (1 - up), depth];
}

test("points of settings are drawn where SuperSplat's viewer draws them, in windows of any shape", () => {
  const own = globalThis as { innerWidth?: number; innerHeight?: number };
  const points: Vec3[] = [[0, 0, 0], [0.7, 0.2, -0.4], [-1.1, 0.9, 0.3], [0.2, -1.3, 0.8]];
  for (const [width, height] of [[1600, 900], [900, 1600], [700, 700], [390, 844], [2000, 500]]) {
    [own.innerWidth, own.innerHeight] = [width, height];
    for (const fov of [30, 60, 90]) {
      const pose = { position: [2.5, 1.2, 3] as Vec3, target: [0.1, -0.2, 0.3] as Vec3, fov };
      const [view] = readSettings({ version: 2, cameras: [{ initial: pose }] }).views;
      const shown = { eye: view.eye, to: view.to, fov: fovOf(view) / rigs.DEGREES };
      for (const point of points) {
        const found = project([-point[0], -point[1], point[2]], shown, [0, -1, 0], width, height)!;
        near([found.x, found.y, found.depth], drawnBySuperSplat(pose, point, width, height), 1e-6);
      }
    }
  }
  delete own.innerWidth;
  delete own.innerHeight;
});

test("an address can say which way is up", () => {
  assert.deepEqual(readUp("#eye=1,2,3&up=0,-1,0"), [0, -1, 0]);
  for (const bad of ["", "#up=0,0,0", "#up=1,2", "#up=x,0,0"]) assert.equal(readUp(bad), null);
});

test("a point in front is drawn where the camera sees it, one behind is not", () => {
  const view = { eye: [0, 0, 0], to: [0, 5, 0], fov: 90 } as const, up: Vec3 = [0, 0, 1];
  const at = (point: Vec3): number[] | null => {
    const found = project(point, view as never, up, 400, 200);
    return found && [found.x, found.y, found.depth];
  };
  near(at([0, 2, 0])!, [200, 100, 2]);
  near(at([2, 2, 1])!, [300, 50, 2]);
  assert.equal(at([0, -1, 0]), null);
  const far = project([2, 2, 1], { ...view, eye: [0, 0, 0], to: [0, 5, 0] }, [0, 0, -1], 400, 200)!;
  near([far.x, far.y], [100, 150]);
});

const TRACK = {
  name: "round", duration: 4, frameRate: 10, loopMode: "none", interpolation: "spline", smoothness: 1,
  keyframes: {
    times: [0, 10, 40],
    values: { position: [0, 0, 0, 1, 2, 3, 4, 0, 0], target: [0, 5, 0, 0, 5, 0, 0, 5, 0], fov: [60, 70, 200] },
  },
};
const tourOf = (changes: object = {}, more: object = {}): Tour =>
  readTour({ version: 2, frame: "scene", animTracks: [{ ...TRACK, ...changes }], ...more });

test("a camera passes through the keys of its track, and ends as the track says", () => {
  const tour = tourOf();
  assert.deepEqual(tour.at(0), { eye: [0, 0, 0], to: [0, 5, 0], fov: 60 });
  assert.deepEqual(tour.at(1), { eye: [1, 2, 3], to: [0, 5, 0], fov: 70 });
  assert.deepEqual(tour.at(4), { eye: [4, 0, 0], to: [0, 5, 0], fov: 120 });
  assert.equal(tour.at(4.01), null);
  const there = tourOf({ loopMode: "pingpong" });
  for (const [late, early] of [[5, 3], [7.5, 0.5], [9, 1]]) assert.deepEqual(there.at(late), there.at(early));
  const round = tourOf({ loopMode: "repeat" });
  assert.deepEqual(round.at(5), round.at(1));
  assert.deepEqual(round.at(1)!.eye, [1, 2, 3]);
  assert.deepEqual(tourOf({ interpolation: "step" }).at(3.9)!.eye, [1, 2, 3]);
});

test("a track says its length, how it ends, and which of its seconds is shown", () => {
  assert.deepEqual([tourOf().duration, tourOf({ loopMode: "for ever" }).loops], [4, "none"]);
  assert.deepEqual([3, 4, 4.5].map(tourOf().second), [3, 4, null]);
  assert.deepEqual([3, 4, 4.5].map(tourOf({ loopMode: "repeat" }).second), [3, 0, 0.5]);
  assert.deepEqual([3, 4, 4.5, 8].map(tourOf({ loopMode: "pingpong" }).second), [3, 4, 3.5, 0]);
});

test("curves are straight where keys lie evenly on a line, and have no corner at a key", () => {
  const times = [0, 2, 4, 6], points = times.map((time) => [3 * time - 1]);
  for (let time = 0; time <= 6; time += 0.25) near(along(times, points, time, 1), [3 * time - 1]);
  const bent = [[0], [5], [1], [1]], step = 1e-5;
  const slope = (time: number): number => (along(times, bent, time + step, 1)[0] - along(times, bent, time, 1)[0]) / step;
  near([slope(2 - step)], [slope(2)], 1e-3);
  near([slope(2)], [1 / 4], 1e-3);
  near(along(times, bent, 3, 0), [3]); // no slope at keys: half way in the middle
});

test("tracks of version 1: the frame is turned, times without a rate are seconds, the camera names track and angle", () => {
  const { frameRate: _, ...bare } = TRACK, { fov: __, ...values } = TRACK.keyframes.values;
  const keyframes = { times: [0, 1, 4], values };
  const tour = readTour({
    camera: { fov: 50, animTrack: "round" }, animTracks: [{ ...TRACK, name: "other", duration: 1 }, { ...bare, keyframes }],
  });
  assert.deepEqual(tour.at(1), { eye: [-1, -2, 3], to: [-0, -5, 0], fov: 50, longer: true });
});

test("a track that makes no sense is refused in one line", () => {
  const { keyframes } = TRACK, { values } = keyframes;
  for (const bad of [
    { duration: 0 }, { duration: "4" }, { keyframes: null }, { keyframes: { ...keyframes, times: [0, 10, 10] } },
    { keyframes: { ...keyframes, times: [0, 10] } }, { keyframes: { times: [], values: { position: [], target: [] } } },
    { keyframes: { ...keyframes, values: { ...values, position: [0, 0, 0, 1, 2, 3, 4, 0, 1e9] } } },
  ]) assert.throws(() => tourOf(bad), /^Error: Expected an animation/);
  assert.throws(() => readTour({}), /^Error: Expected an animation/);
});

test("a track leads the view until it ends or somebody moves, and nothing jumps then", () => {
  const frame = v.frameFromUp([0, 0, 1]), navigator = new Navigator(frame, rigs.rigFromTarget([0, 0, 0], [1, 0, 0], frame));
  let passed = 0;
  const lead = (seconds: number) =>
    (passed += seconds) > 1 ? null : rigs.rigFromTarget([passed, 0, 0], [passed, 5, 0], frame);
  navigator.track = lead;
  assert.ok(navigator.step(0.5) && navigator.flying);
  assert.deepEqual(navigator.shown.eye, [0.5, 0, 0]);
  navigator.step(0.6);
  assert.deepEqual([navigator.flying, navigator.shown.eye], [false, [0.5, 0, 0]]);
  passed = 0;
  navigator.track = lead;
  navigator.step(0.25);
  navigator.drag(0.1, 0);
  navigator.step(0.01);
  assert.deepEqual([navigator.flying, navigator.track], [false, null]);
  assert.ok(Math.abs(navigator.shown.turn - rigs.rigFromTarget([0.25, 0, 0], [0.25, 5, 0], frame).turn) <= 0.1);
});

test("numbers as people read them", () => {
  assert.deepEqual(
    [0, 999, 1000, 12449, 999950, 1.5e6].map(formatCount), ["0", "999", "1.00 k", "12.4 k", "1.00 M", "1.50 M"],
  );
  assert.deepEqual([12, 7.2e6, NaN].map(formatBytes), ["12 B", "7.20 MB", "–"]);
  assert.deepEqual([0.43, 12, 180].map(formatSeconds), ["0.43 s", "12.0 s", "3 min"]);
  assert.deepEqual([0.0004, 0.032, 0.45].map(formatShare), ["under 0.1%", "3.2%", "45%"]);
  assert.deepEqual([formatLength(2, 0), formatLength(2, 0.5)], ["2.00 units", "1.00 m"]);
});

test("rotations and quaternions are the same turn, whichever of the four numbers is largest", () => {
  const turns: [number, number, number, number][] = [
    [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1], [0.1, 0.9, -0.3, 0.2], [0.1, -0.2, 0.9, 0.3],
    [0.1, 0.2, 0.3, -0.9],
  ];
  for (const turn of turns) {
    const size = Math.hypot(...turn), unit = turn.map((value) => value / size), found = quaternionOf(rotationOf(turn));
    const sign = Math.sign(found.reduce((sum, value, k) => sum + value * unit[k], 0));
    near(found.map((value) => sign * value), unit);
    near([Math.hypot(...found)], [1]);
  }
});
