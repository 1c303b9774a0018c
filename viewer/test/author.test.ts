// Settings that authors make: what is read of a draft is what the page had, and a path goes through its views.
import assert from "node:assert/strict";
import { test } from "node:test";
import { draftOf, trackOf } from "../src/page/author.ts";
import { spotsOf } from "../src/page/hotspots.ts";
import { readSettings } from "../src/page/settings.ts";
import { readTour } from "../src/page/tour.ts";

const POSES = [[[1, 2, 3], [4, 2, 1]], [[-2, 0.5, 1], [0, 0, 1]], [[3, 3, 1.5], [0, 1, 1]]];
const SCENE = {
  version: 2, frame: "scene", gsvis: "mark",
  cameras: POSES.map(([position, target], k) => ({ name: `view ${k}`, initial: { position, target, fov: 60 } })),
  annotations: [{
    position: [1, 1, 1], title: "Table", text: "Oak", extras: { link: "https://example.org/" },
    camera: { initial: { position: [2, 1, 1], target: [1, 1, 1], fov: 60 } },
  }],
};

test("a draft of settings in the scene's frame is read as the same views and hotspots", () => {
  const before = readSettings(SCENE), draft = draftOf(SCENE, 1), after = readSettings(draft);
  assert.equal("frame" in draft || "gsvis" in draft, false);
  const plain = (all: typeof before): unknown => JSON.parse(JSON.stringify(all.views.map(({ longer: _, ...view }) => view)));
  assert.deepEqual(plain(after), plain(before));
  const [spot] = spotsOf(draft);
  assert.deepEqual([spot.at, spot.title, spot.text, spot.link], [[1, 1, 1], "Table", "Oak", "https://example.org/"]);
  assert.deepEqual(draftOf(draft, 2), draft, "a draft stays as it is");
  const wide = draftOf(SCENE, 16 / 9).cameras[0].initial.fov;
  assert.ok(Math.abs(Math.tan(wide * Math.PI / 360) - (16 / 9) * Math.tan(Math.PI / 6)) < 1e-4);
});

test("settings of version 1, none, and ones that make no sense give a draft that is read", () => {
  const old = { camera: { position: [1, 2, 3], target: [0, 0, 0], fov: 50 }, background: { color: [0, 0.5, 1] } };
  assert.deepEqual(readSettings(draftOf(old, 1)).views.map(({ eye, fov }) => [eye, fov]), [[[-1, -2, 3], 50]]);
  assert.deepEqual(readSettings(draftOf(old, 1)).background, [0, 0.5, 1]);
  for (const bad of [null, [], { cameras: 3, annotations: [{ position: "x" }], animTracks: {}, startMode: 1 }]) {
    const { cameras, annotations, animTracks, startMode } = draftOf(bad, 1);
    assert.deepEqual([cameras, annotations, animTracks, startMode], [[], [], [], "default"]);
  }
});

test("a path is at each view at its time, ends with the last one, or comes back to the first", () => {
  const draft = draftOf(SCENE, 1);
  for (const loops of [false, true]) {
    const tour = readTour({ ...draft, animTracks: [trackOf(draft.cameras, 3, loops)] });
    POSES.forEach(([eye, to], k) => {
      const found = tour.at(Math.abs(3 * k - 1e-9))!;
      for (const [a, b] of [[found.eye, eye], [found.to, to]]) a.forEach((x, i) => assert.ok(Math.abs(x - b[i]) < 1e-4));
    });
    assert.equal(tour.at(9.5) === null, !loops);
  }
});

test("a path of the scene's frame is turned with the rest", () => {
  const track = { ...trackOf(draftOf(SCENE, 1).cameras, 3, false) }, own = { ...SCENE, animTracks: [track] };
  const turned = draftOf(own, 1), [before, after] = [readTour(own).at(1.5)!, readTour(turned).at(1.5)!];
  for (const key of ["eye", "to"] as const) before[key].forEach((x, i) => assert.ok(Math.abs(x - after[key][i]) < 1e-6));
});
