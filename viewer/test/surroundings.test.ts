// What the page makes of a server's facts: first views, globes, addresses, lists; and of a server that says nonsense.

import assert from "node:assert/strict";
import { test, type TestContext } from "node:test";
import { deflateSync } from "node:zlib";
import type { Header, Source, SourceEvents } from "../src/core/types.ts";
import { readAddress, type SceneAddress } from "../src/page/address.ts";
import { begin, guessMeter } from "../src/page/begin.ts";
import { Facts, readCells, readFloor, readPoses, readWhy } from "../src/page/facts.ts";
import type { Cells } from "../src/page/facts.ts";
import { readPad } from "../src/page/gamepad.ts";
import { globeFaces, matchFaces } from "../src/page/globe.ts";
import { readScenes } from "../src/page/list.ts";
import { describeState, explainFailure } from "../src/page/messages.ts";
import { edgesOf } from "../src/page/overlay.ts";
import { pivot } from "../src/page/rig.ts";
import { awaitMore, factsOf, holdPoses } from "../src/page/scene.ts";
import { startInCells, startOnFloor, surroundedBy } from "../src/page/start.ts";
import * as v from "../src/page/vector.ts";
import type { Vec3 } from "../src/page/vector.ts";

const FRAME = v.frameFromUp([0, 0, 1]);
const NONE = { floor: null, cells: null, poses: [] };

const FLOOR = {
  origin: [0, 0, 0], side: 1, first: [1, 0, 0], second: [0, 1, 0], up: [0, 0, 1], columns: 1, rows: 2,
  heights: [1, 1, 1],
};

/** A hall of 9 x 5 squares with a niche; heights of 1.6. */
const hall = () => {
  const heights = new Array<number | null>(45).fill(1.6);
  for (let y = 0; y < 5; y++) heights[y * 9 + 8] = y === 2 ? 1.6 : null;
  return readFloor(
    { origin: [10, 0, 0], side: 1, first: [1, 0, 0], second: [0, 1, 0], up: [0, 0, 1], columns: 9, rows: 5, heights }
  );
};

const ring = (): Cells => {
  const boxes: Vec3[] = [];
  for (let x = 0; x < 7; x++) {
    for (let y = 0; y < 7; y++) {
      if (
        Math.max(Math.abs(x - 3), Math.abs(y - 3)) >= 2
      ) {
        boxes.push([x, y, 0]);
      }
    }
  }
  return { origin: [0, 0, 0], size: 2, boxes };
};

const row = (): Cells => ({
  origin: [0, 0, 0], size: 1, boxes: [[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0], [4, 0, 0]],
});

test("marks are bytes, and what is none counts as absent", async (context: TestContext) => {
  const answers: unknown[] = [{ cells: "AAH/", weights: "/wAB" }, null, { cells: "%", weights: "" }];
  context.mock.method(globalThis, "fetch", () => Promise.resolve(Response.json(answers.shift())));
  const known = await new Facts("http://a/").marks();
  assert.deepEqual([[...known?.visibility ?? []], [...known?.weight ?? []]], [[0, 1, 255], [255, 0, 1]]);
  for (let k = 0; k < 2; k++) assert.equal(await new Facts("http://a/").marks(), null);
});

test("a visit begins where the floor is widest and looks where it reaches farthest", () => {
  const floor = hall();
  assert.ok(floor);
  const rig = startOnFloor(floor, FRAME);
  assert.ok(rig);
  assert.ok(Math.abs(rig.eye[1] - 2.5) < 0.01 && Math.abs(rig.eye[2] - 1.6) < 1e-6);
  const ahead = v.normalize(v.subtract(pivot(rig, FRAME), rig.eye));
  assert.ok(Math.abs(ahead[0]) > 0.9 && Math.abs(ahead[2]) < 1e-6);
});

test("cells around something have a middle, a row of cells has none", () => {
  const middle = surroundedBy(ring(), FRAME);
  assert.ok(middle && v.distance(middle, [7, 7, 1]) < 1e-9);
  assert.equal(surroundedBy(row(), FRAME), null);
  const rig = startInCells(row(), FRAME);
  assert.ok(rig && v.distance(rig.eye, [2.5, 0.5, 0.5]) < 1e-9);
});

test("indoors begins in walk or fly, around an object in orbit, unknown scenes in orbit", () => {
  assert.equal(begin("", [], FRAME, { ...NONE, floor: hall(), cells: row() }).mode, "walk");
  assert.equal(begin("", [], FRAME, { ...NONE, cells: row() }).mode, "fly");
  const around = begin("", [], FRAME, { ...NONE, floor: hall(), cells: ring() });
  assert.equal(around.mode, "orbit");
  assert.ok(v.distance(pivot(around.rig, FRAME), [7, 7, 1]) < 1e-9);
  assert.equal(begin("", [], FRAME, NONE).mode, "orbit");
});

test("of a scene without floor and cells, the proposed view says how to move", () => {
  const pose = (mode: unknown) => readPoses([{ position: [5, 5, 5], rotation: [1, 0, 0, 0], mode }]);
  assert.equal(begin("", [], FRAME, { ...NONE, poses: pose("fly") }).mode, "fly");
  assert.equal(begin("", [], FRAME, { ...NONE, poses: pose("orbit") }).mode, "orbit");
  assert.equal(begin("", [], FRAME, { ...NONE, poses: pose("swim") }).mode, "orbit");
  assert.equal(begin("", [], FRAME, { ...NONE, floor: hall(), cells: row(), poses: pose("fly") }).mode, "walk");
});

test("the address decides, then settings, then what the scene proposes", () => {
  const settings = [{ eye: [1, 1, 1] as Vec3, to: [2, 1, 1] as Vec3, fov: 50 }];
  const poses = [{ position: [5, 5, 5] as Vec3, rotation: [1, 0, 0, 0] as [number, number, number, number] }];
  const around = { floor: null, cells: row(), poses };
  assert.deepEqual(begin("#eye=2,0,0&to=3,0,0&mode=fly", settings, FRAME, around).rig.eye, [2, 0, 0]);
  assert.deepEqual(begin("", settings, FRAME, around).rig.eye, [1, 1, 1]);
  assert.deepEqual(begin("", [], FRAME, around).rig.eye, [5, 5, 5]);
});

test("views that cannot be, or lie outside of the scene, are said and the first view is taken", () => {
  const around = { ...NONE, cells: row() };
  const first = begin("", [], FRAME, around).rig;
  for (const hash of ["#eye=1&to=2", "#eye=90000,0,0&to=0,0,0"]) {
    const found = begin(hash, [], FRAME, around);
    assert.ok(found.problem);
    assert.deepEqual(found.rig, first);
  }
});

test("a meter is what the scene says, else a tenth of the cells", () => {
  const header = { metersPerUnit: 0.5 } as Header;
  assert.equal(guessMeter(header, row()), 2);
  assert.ok(Math.abs(guessMeter({ ...header, metersPerUnit: 0 }, row()) - Math.hypot(5, 1, 1) / 10) < 1e-12);
});

test("a server that says nonsense costs a panel, never an error", () => {
  const nonsense = [null, 3, "x", [], {}, { origin: "a" }, { seeing: 3 }, {
    cells: 5, directions: { of: "x", seen: [[1]] },
  },
    { origin: [0, 0, 0], size: -1, boxes: [] }, { origin: [0, 0, 0], size: 1, boxes: [] },
    { origin: [0, 0, 0], size: 1, boxes: [[0, 0, 0], 7] },
    { ...FLOOR, columns: 1.5 }, { ...FLOOR, heights: [null, null] }, { columns: 1e9, rows: 1e9, heights: [] }];
  for (const one of nonsense) {
    assert.equal(readFloor(one), null);
    assert.equal(readCells(one), null);
    assert.doesNotThrow(() => readWhy(one));
  }
  assert.deepEqual(readWhy({ cells: null, directions: null }), { cells: null, directions: null });
});

test("a hundred thousand cells are read and begun in, more are not", () => {
  const boxes = Array.from({ length: 100_000 }, (_, k): Vec3 => [k, 0, 0]),
    many = { origin: [0, 0, 0], size: 1, boxes };
  const cells = readCells(many);
  assert.ok(cells);
  const rig = startInCells(cells, FRAME);
  assert.ok(rig && Math.abs(rig.eye[0] - 50_000) <= 1);
  assert.equal(guessMeter({ metersPerUnit: 0 } as Header, cells), Math.hypot(100_000, 1, 1) / 10);
  assert.doesNotThrow(() => begin("#eye=1,0,0&to=2,0,0", [], FRAME, { ...NONE, cells }));
  assert.equal(readCells({ ...many, boxes: [...boxes, [0, 1, 0]] }), null);
});

test("an answer is kept, and so is that there is none; a question without an answer is asked again", async (t) => {
  const asked = answer(t, null, 503, row(), 404), facts = new Facts("http://a.example/scenes/hall/");
  for (const expected of [null, null, row(), row()]) assert.deepEqual(await facts.cells(), expected);
  assert.equal(asked.length, 3);
  for (let k = 0; k < 2; k++) assert.equal(await facts.why(7), null);
  assert.equal(asked.length, 4);
});

test("a static scene has cells, floor and views in its files, and answers no other question", async (t) => {
  const held = deflateSync(JSON.stringify({ cells: row(), floor: { ...FLOOR, heights: [1.6, null] } }));
  const poses = [{ position: [1, 2, 3], rotation: [1, 0, 0, 0] }], name = "facts-0123456789abcdef.bin", asked: string[] = [];
  let answers: Record<string, unknown> = {};
  t.mock.method(globalThis, "fetch", (url: string) => {
    asked.push(url);
    const found = answers[url.slice("http://a.example/s/".length)];
    return Promise.resolve(found instanceof Uint8Array
      ? new Response(new Uint8Array(found)) : found ? Response.json(found) : new Response("", { status: 404 }));
  });
  const open = (url: string): Facts => factsOf({ kind: "static", name: "s", url, root: null });
  answers = { "scene.json": { poses, files: { facts: { name } } }, [name]: held };
  for (const url of ["http://a.example/s", "http://a.example/s/", "http://a.example/s/scene.json"]) {
    const facts = open(url);
    assert.deepEqual([(await facts.cells())?.boxes.length, (await facts.views()).length], [row().boxes.length, 1]);
    assert.deepEqual([...(await facts.floor())!.heights], [Math.fround(1.6), NaN]);
    assert.deepEqual([facts.known, await facts.marks(), await facts.why(3)], [false, null, null]);
  }
  assert.deepEqual(new Set(asked), new Set(["http://a.example/s/scene.json", `http://a.example/s/${name}`]));
  answers = { "scene.json": { poses } }; // a bare scene
  assert.deepEqual([await open("http://a.example/s").cells(), (await open("http://a.example/s").views()).length], [null, 1]);
  const cut = { "scene.json": { poses, files: { facts: { name } } }, [name]: held.subarray(0, 20) };
  for (const [damaged, views] of [[{}, 0], [cut, 1]] as const) {
    answers = damaged;
    const facts = open("http://a.example/s");
    assert.deepEqual([await facts.floor(), await facts.cells(), (await facts.views()).length], [null, null, views]);
  }
});

test("facts of a Gaussian are read, rows of directions nested or not", () => {
  const why = readWhy({
    cells: {
      of: 12, size: 1,
      seeing: [{ cell: 3, distance: 2, weight: [0.1, 0.2] }, { cell: 4, distance: 9, weight: null }, { cell: "x" }],
    },
    directions: { of: 80, seen: [[0, 0, 2], [[1, 0, 0]]] },
  });
  assert.deepEqual(why?.cells?.seeing.map(({ cell }) => cell), [3, 4]);
  assert.deepEqual(why?.directions?.seen, [[0, 0, 1], [1, 0, 0]]);
});

test("the globe has 80 faces that cover the sphere, each found by its center", () => {
  const faces = globeFaces();
  assert.equal(faces.length, 80);
  assert.equal(matchFaces(faces, faces.map((face) => face.center)).filter(Boolean).length, 80);
  assert.ok(v.length(faces.map((face) => face.center).reduce(v.add)) < 1e-9);
});

test("edges that cells share are drawn once", () => {
  assert.equal(edgesOf({ origin: [0, 0, 0], size: 1, boxes: [[0, 0, 0]] }).length, 12);
  assert.equal(edgesOf({ origin: [0, 0, 0], size: 1, boxes: [[0, 0, 0], [1, 0, 0]] }).length, 20);
});

test("addresses: a server's scene behind any prefix, a static folder, a stream, and what no page opens", () => {
  const none = { scene: null, content: null, settings: null };
  const one = readAddress("https://x.org/a/b/view/my%20room?token=t", none);
  assert.deepEqual(
    one.scene, { kind: "stream", name: "my room", url: "wss://x.org/a/b/stream/my%20room", root: "https://x.org/a/b/" },
  );
  assert.equal(one.token, "t");
  const folder = readAddress("https://x.org/site/index.html", { ...none, content: "room/" });
  assert.deepEqual(folder.scene, { kind: "static", name: "room", url: "https://x.org/site/room/", root: null });
  const named = { ...none, origins: "http://h" }; // by whoever wrote the page
  assert.equal(readAddress("http://x.org/view/a?content=ws://h/stream/b", none).scene, null);
  assert.equal(readAddress("http://x.org/view/a?content=ws://h/stream/b", named).scene?.kind, "stream");
  assert.equal(readAddress("http://x.org/view/a?content=javascript:alert(1)", none).scene, null);
  assert.equal(readAddress("http://x.org/", none).scene, null);
  const content = "room/", shown = (link: string) => readAddress(`http://x.org/s/?content=${link}`, { ...none, content });
  for (const link of ["wss://h/stream/b", "http://h/room/", "//h/room/", "http://x.org:81/", "data:,", "inline:"]) {
    assert.equal(shown(link).scene, null, link);
  }
  assert.equal(shown("../other/").scene?.url, "http://x.org/other/");
  assert.equal(shown("ws://x.org/stream/b").scene?.kind, "stream");
  assert.equal(readAddress("http://x.org/view/a?settings=s.json", none).settings, "http://x.org/view/s.json");
  assert.equal(readAddress("http://x.org/view/%E0%A4%A", none).scene?.name, "%E0%A4%A");
});

test("lists of scenes: rows with names, nothing that is none", () => {
  const rows = readScenes({ scenes: [{ name: "a b", gaussians: 5 }, { name: "<img>" }, 7, {}] });
  assert.deepEqual(
    rows.map(({ name, href, gaussians }) => [name, href, gaussians]),
    [["a b", "view/a%20b", 5], ["<img>", "view/%3Cimg%3E", null]],
  );
  assert.deepEqual(readScenes(null), []);
});

test("no pose reaches a source before the first view is chosen; then the latest does", () => {
  const sent: number[] = [];
  const inner: Source = {
    start: () => undefined, view: () => undefined, close: () => undefined,
    pose: (pose) => void sent.push(pose.position[0]),
  };
  const { source, release } = holdPoses(inner);
  for (const x of [1, 2]) source.pose({ position: [x, 0, 0], rotation: [1, 0, 0, 0] });
  assert.deepEqual(sent, []);
  release();
  release();
  source.pose({ position: [3, 0, 0], rotation: [1, 0, 0, 0] });
  assert.deepEqual(sent, [2, 3]);
});

test("a source starts at once, and what it has said until somebody listens comes in order", async () => {
  let say: SourceEvents | null = null;
  const inner: Source = {
    start: (events) => { say = events; }, view: () => undefined, close: () => undefined, pose: () => undefined,
  };
  const { source, header: first } = holdPoses(inner), heard: string[] = [], fresh: boolean[] = [];
  const { state, header } = say as unknown as SourceEvents;
  state({ kind: "connecting" });
  header({ gaussians: 7 } as Header, true);
  header({ gaussians: 8 } as Header, true);
  assert.equal((await first).gaussians, 7);
  source.start({
    state: ({ kind }) => heard.push(kind), batch: () => undefined, traffic: () => undefined,
    header: (_, isFresh) => { heard.push("header"); fresh.push(isFresh); },
  });
  state({ kind: "streaming" });
  await Promise.resolve();
  await Promise.resolve();
  state({ kind: "complete" });
  assert.deepEqual([heard, fresh], [["connecting", "header", "header", "streaming", "complete"], [true, true]]);
});

test("gamepads rest where sticks hardly move", () => {
  const buttons = Array.from({ length: 17 }, () => ({ pressed: false, value: 0 }));
  buttons[7] = { pressed: true, value: 0.5 };
  const held = readPad({ axes: [0.05, -1, 0.56, 0], buttons });
  assert.deepEqual([held.aside, held.ahead, held.above, held.tilt], [0, 1, 0.5, 0]);
  assert.ok(Math.abs(held.turn - 0.5) < 1e-9);
});

test("every end of a source has words", () => {
  assert.ok(explainFailure("no", 4).token);
  for (const code of [undefined, 1, 2, 3, 5, 6, 7, 8, 9, 77]) {
    const { title, text, retry } = explainFailure("x".repeat(5000), code);
    assert.ok(title && text && retry);
  }
  assert.equal(describeState({ kind: "waiting", seconds: 2.2, message: "" }, 5), "Retrying in 3 s");
});

/** Answer requests of a test, one after the other; `null` is a server that does not answer. */
function answer(t: TestContext, ...answers: unknown[]): string[] {
  const asked: string[] = [];
  t.mock.method(globalThis, "fetch", (address: string) => {
    asked.push(address);
    const next = answers.shift();
    if (next === null) return Promise.reject(new TypeError("no connection"));
    return Promise.resolve(typeof next === "number" ? new Response("", { status: next }) : Response.json(next));
  });
  return asked;
}

const SCENE: SceneAddress = {
  kind: "static", name: "hall", url: "http://a.example/scenes/hall/", root: "http://a.example/",
};
const listed = (row: object): object => ({ scenes: [{ name: "hall", stream: null, static: null, ...row }] });

test("a scene that is being prepared is asked for until it streams, also after silence", async (t) => {
  const waits: number[] = [], preparing = listed({ static: "scenes/hall/", preparing: true });
  const asked = answer(
    t, preparing, null, 503, null, { nonsense: 1 }, null, null, null, null, preparing, listed({ stream: "stream/hall" }),
  );
  const found = await awaitMore(SCENE, () => true, null, async (milliseconds) => void waits.push(milliseconds));
  assert.deepEqual(found, { ...SCENE, kind: "stream", url: "ws://a.example/stream/hall" });
  assert.equal(asked.length, 11);
  assert.deepEqual(waits.map(Math.round), [250, 258, 515, 1030, 2060, 4120, 8240, 16_480, 32_960, 60_000, 336]);
});

test("a scene whose preparation has ended without a stream is not asked for again", async (t) => {
  const asked = answer(t, listed({ static: "scenes/hall/", preparing: false }));
  assert.equal(await awaitMore(SCENE, () => true, null, async () => undefined), null);
  assert.equal(asked.length, 1);
});

test("a scene of which a sample is shown is asked for until the whole of it is there", async (t) => {
  const sample = listed({ static: "scenes/hall/", preparing: true, gaussians: 100 });
  const whole = listed({ static: "scenes/hall/", preparing: false, gaussians: 900 });
  const asked = answer(t, sample, sample, whole);
  const found = await awaitMore(SCENE, () => true, 100, async () => undefined);
  assert.deepEqual(found, { ...SCENE, kind: "static", url: "http://a.example/scenes/hall/" });
  assert.equal(asked.length, 3);
});
