// Static scenes over a small HTTP server: all that a cell needs arrives; cuts, gaps and outages are gone round.
import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { createServer, type IncomingMessage, type ServerResponse } from "node:http";
import type { AddressInfo } from "node:net";
import { join } from "node:path";
import { test, type TestContext } from "node:test";
import { Arrivals } from "../src/core/static-arrivals.ts";
import { FirstView } from "../src/core/static-first.ts";
import { hasLittle, sectorsOf } from "../src/core/static-glances.ts";
import { Index } from "../src/core/static-index.ts";
import { type ChunkRows, readPiece } from "../src/core/static-pieces.ts";
import { StaticHost } from "../src/core/static-host.ts";
import type { Report } from "../src/core/worker-source.ts";
import { HeldParts, HttpParts } from "../src/core/static-parts.ts";
import { type Choice, choose, frustum, HELD, type Holdings, insideOf, NONE, sphereOf, worthOf } from "../src/core/static-plan.ts";
import { Cells, readRow } from "../src/core/static-cells.ts";
import { PlainArrivals } from "../src/core/static-plain.ts";
import { parseScene, type StaticScene } from "../src/core/static-scene.ts";
import type { SetBlocks } from "../src/core/static-sets.ts";
import { baseOf } from "../src/core/static-source.ts";
import { decodeMean, recordLayout } from "../src/core/tables.ts";
import { type Clock, REAL_TIME } from "../src/core/traffic.ts";
import type { Batch, Pose, SourceState, Traffic, View } from "../src/core/types.ts";
import { FakeClock } from "./fakes.ts";

interface Recorded {
  files: Record<string, string>;
  records: string[];
  means: number[][];
  parts: number[][]; // ids
  cells: { gains: number[]; spheres: number[][] }[]; // spheres: center and radius
  terms?: string[][];
  centers?: number[][];
  harmonics?: string[];
}

const VECTOR = JSON.parse(
  readFileSync(join(import.meta.dirname, "../../tests/export/vector.json"), "utf8")
) as { package: Recorded; bare: Recorded; near: Recorded };
const VIEW: View = { left: 1, right: 1, up: 1, down: 1 };
const SET = 24; // bytes of a set of harmonics of degree 2

function filesOf(scene: Recorded): Map<string, Buffer> {
  return new Map(Object.entries(scene.files).map(([name, text]) => [name, Buffer.from(text, "base64")]));
}

type Answer = (name: string, data: Buffer | undefined, request: IncomingMessage, response: ServerResponse) => boolean;

/** A file server with ranges; `before` may answer in its place. */
async function serve(
  t: TestContext, files: Map<string, Buffer>, before: Answer = () => false,
): Promise<{ url: string; asked: string[] }> {
  const asked: string[] = [];
  const server = createServer((request, response) => {
    const name = (request.url ?? "").replace(/^\//, ""), data = files.get(name),
      range = /^bytes=(\d+)-(\d+)$/.exec(request.headers.range ?? "");
    asked.push(`${name} ${request.headers.range ?? "whole"}`);
    if (before(name, data, request, response)) return;
    if (data === undefined) response.writeHead(404).end();
    else if (range === null) response.writeHead(200).end(data);
    else if (Number(range[1]) >= data.length) response.writeHead(416).end();
    else {
      const [start, end] = [Number(range[1]), Math.min(Number(range[2]) + 1, data.length)];
      response.writeHead(
        206, { "Content-Range": `bytes ${start}-${end - 1}/${data.length}` },
      ).end(data.subarray(start, end));
    }
  });
  await new Promise<void>((done) => { server.listen(0, "127.0.0.1", done); });
  t.after(() => {
    server.close();
    server.closeAllConnections();
  });
  return { url: `http://127.0.0.1:${(server.address() as AddressInfo).port}/`, asked };
}

/** A page without its renderer; `until` fails after a minute. */
class Client {
  readonly batches: Batch[] = [];
  readonly states: SourceState[] = [];
  headers = 0;
  private width = SET; // bytes of a set as it comes
  readonly traffic: Traffic[] = [];
  readonly sets: string[] = []; // of harmonics, in hexadecimal digits
  private listeners: (() => void)[] = [];
  readonly host: StaticHost;

  constructor(t: TestContext, url: string, held: Map<string, Blob> | null = null, clock: Clock = REAL_TIME) {
    this.host = new StaticHost((report) => this.take(report), clock, (events, stop) =>
      held === null ? new HttpParts(
        url, events, stop, { sleep: () => new Promise((done) => { setImmediate(done); }), random: () => 0.5 },
      ) : new HeldParts(held, events));
    t.after(() => this.host.close()); // also where a test fails: what asks on keeps Node alive
  }

  private take(report: Report): void {
    if (report.kind === "batch") this.batches.push(report.batch);
    else if (report.kind === "state") this.states.push(report.state);
    else if (report.kind === "header") [this.headers, this.width] = [this.headers + 1, report.header.plain ? 32 : SET];
    else if (report.kind === "sets") this.keep(report.first, report.sets);
    else this.traffic.push(report.traffic);
    for (const listener of this.listeners) listener();
  }

  private keep(first: number, sets: Uint8Array): void {
    for (let k = 0; k < sets.length / this.width; k++) {
      const set = sets.slice(this.width * k, this.width * k + SET);
      this.sets[first + k] = Buffer.from(this.width === SET ? set : set.map((value) => value ^ 128)).toString("hex");
    }
  }

  async until(holds: () => boolean): Promise<void> {
    await new Promise<void>((done, fail) => {
      const guard = setTimeout(() => fail(new Error(`nothing more comes: ${JSON.stringify(this.states)}`)), 60_000);
      const check = (): void => {
        if (!holds()) return;
        clearTimeout(guard);
        this.listeners = this.listeners.filter((each) => each !== check);
        done();
      };
      this.listeners.push(check);
      check();
    });
  }

  complete(): boolean {
    return this.states.at(-1)?.kind === "complete";
  }

  look(position: number[], rotation: Pose["rotation"] = [1, 0, 0, 0]): void {
    this.host.setView(VIEW);
    this.host.setPose({ position: [position[0], position[1], position[2]], rotation });
  }

  /** What is missing, "" if nothing. */
  get message(): string {
    const last = this.states.at(-1);
    return last?.kind === "complete" ? last.message ?? "" : "";
  }

  get ids(): number[] {
    return this.batches.flatMap((batch) => [...batch.ids]);
  }
}

/**
 * Check that what came is what the scene holds, and that slots, rows and terms are numbered in the order of arrival.
 */
function check(scene: Recorded, batches: Batch[], sets: string[] = []): void {
  const owned = new Map<number, string[]>(), ids: number[] = [];
  let rows = 0, terms = 0;
  const width = scene.terms === undefined ? 0 : 5;
  for (const batch of batches) {
    assert.equal(batch.first, ids.length);
    assert.equal(batch.firstRow, rows);
    assert.equal(batch.firstTerm, terms);
    const bytes = Buffer.from(batch.records.buffer, batch.records.byteOffset, batch.records.byteLength);
    for (let i = 0; i < batch.ids.length; i++) {
      const id = batch.ids[i];
      assert.equal(bytes.subarray(16 * i, 16 * i + 16).toString("hex"), scene.records[id]);
      for (let k = 0; k < 3; k++) {
        assert.ok(
          Math.abs(batch.means[3 * i + k] - scene.means[id][k]) < 1e-5 * Math.max(1, Math.abs(scene.means[id][k]))
        );
      }
      assert.ok(batch.rows[i] < rows + batch.chunks.length / 8);
      if (scene.harmonics !== undefined) {
        assert.equal(sets[batch.labels![i]], scene.harmonics[id]);
      }
      ids.push(id);
    }
    for (let t = 0; t < batch.owners.length; t++) {
      const bits = Buffer.alloc(8);
      bits.writeUInt32LE(batch.terms[2 * t], 0);
      bits.writeUInt32LE(batch.terms[2 * t + 1], 4);
      const id = ids[batch.owners[t]];
      owned.set(id, [...owned.get(id) ?? [], bits.subarray(0, width).toString("hex")]);
    }
    rows += batch.chunks.length / 8;
    terms += batch.owners.length;
  }
  assert.equal(new Set(ids).size, ids.length);
  for (const [id, found] of owned) {
    const left = [...scene.terms![id]];
    for (const record of found) {
      assert.ok(left.includes(record));
      left.splice(left.indexOf(record), 1);
    }
  }
}

test("all that a scene has arrives once, what the cell sees first, wherever the eye is", async (t) => {
  const scene = VECTOR.package, { said } = await open(scene), [x, y, z] = scene.centers![0];
  const terms = scene.terms!.reduce((sum, each) => sum + each.length, 0);
  for (const away of [0, 0.8, 50]) {
    const { url, asked } = await serve(t, filesOf(scene)), client = new Client(t, url);
    client.look([x + away * said.cells.size, y, z]);
    await client.host.start();
    await client.until(() => client.complete());
    const seen = scene.parts.filter((_, p) => scene.cells[0].gains[p]> 0).flat();
    const early = new Set(client.ids);
    assert.ok(seen.every((id) => early.has(id)));
    await client.until(() => client.ids.length === scene.records.length &&
      client.batches.reduce((sum, batch) => sum + batch.owners.length, 0) === terms);
    check(scene, client.batches);
    assert.equal(client.headers, 1);
    assert.ok(asked.every((each) => each.endsWith(" whole")));
    const names = asked.map((each) => each.split(" ")[0]);
    assert.equal(new Set(names).size, names.length, asked.join("\n"));
  }
});

test("what comes first of a cell are the glances that the view covers, and none where most of the view is here", async (t) => {
  const scene = VECTOR.package, { said, file } = await open(scene), { glances } = said.cells;
  const cells = await Cells.open(said, file("grid")), row = await readRow(said, file("row", 0), cells.middle(0));
  const { url, asked } = await serve(t, filesOf(scene)), client = new Client(t, url);
  client.look(scene.centers![0]);
  await client.host.start();
  await client.until(() => client.ids.length === scene.records.length && client.complete());
  check(scene, client.batches);
  const kinds = asked.map((each) => each.split("-")[0]).filter((kind) => kind === "glance" || kind === "part");
  const wanted = sectorsOf(glances!, { position: [0, 0, 0], rotation: [1, 0, 0, 0] }, VIEW).filter((sector) => row.glances[sector] > 0);
  assert.ok(wanted.length > 0);
  assert.deepEqual(kinds.slice(0, wanted.length), wanted.map(() => "glance"));
  const numbers = asked.filter((each) => each.startsWith("glance")).map((each) => Number(/-(\d+)\.bin/.exec(each)![1]));
  assert.deepEqual(numbers.sort(), [...wanted].sort());
  const held: Holdings = {
    part: new Uint8Array(said.parts).fill(HELD), terms: new Uint8Array(0), sets: new Uint8Array(0), glance: new Uint8Array(0),
    left: new Float32Array(said.parts).fill(1),
  };
  const worth = new Float32Array(said.parts).fill(1);
  assert.ok(!hasLittle(worth, held));
  held.part.fill(NONE);
  assert.ok(hasLittle(worth, held));
  held.left.fill(0.5); // of the light, a quarter by its square
  assert.ok(!hasLittle(worth, held));
});

test("a view covers the sectors of the horizon around where it looks", () => {
  const glances = { sectors: 8, axes: [[1, 0, 0], [0, 0, 1], [0, -1, 0]] }; // looks along +z: 90 degrees, between sectors 5 and 6
  const ahead = sectorsOf(glances, { position: [0, 0, 0], rotation: [1, 0, 0, 0] }, VIEW);
  assert.deepEqual([...ahead].sort(), [5, 6]);
  const narrow = { left: 0.05, right: 0.05, up: 0.05, down: 0.05 }, right = Math.SQRT1_2;
  assert.deepEqual([...sectorsOf(glances, { position: [9, 9, 9], rotation: [right, 0, right, 0] }, narrow)].sort(), [3, 4]);
});

test("a first view is read while it comes, by one request before any part", async (t) => {
  const scene = VECTOR.package, { said } = await open(scene), { position, rotation } = said.first[0].pose;
  let release: (() => void) | null = null;
  const { url, asked } = await serve(t, filesOf(scene), (name, data, _, response) => {
    if (!name.startsWith("first")) return false;
    response.writeHead(200);
    response.write(data!.subarray(0, data!.length - 1));
    release = () => response.end(data!.subarray(data!.length - 1));
    return true;
  });
  const client = new Client(t, url);
  client.look(position, rotation);
  void client.host.start();
  await client.until(() => client.ids.length > 0);
  assert.ok(!asked.some((each) => /^(part|terms)/.test(each)));
  release!();
  await client.until(() => client.ids.length === scene.records.length && client.complete());
  check(scene, client.batches);
});

test("files asked for ahead are asked for once, and one of another view is dropped", async (t) => {
  const scene = VECTOR.package, { said } = await open(scene), { position, rotation } = said.first[0].pose;
  const names = ["scene.json", ...["index", "grid", "first"].map((kind) => said.files.get(kind)!.name)];
  names[3] += "-0.bin";
  for (const turned of [false, true]) {
    const { url, asked } = await serve(t, filesOf(scene)), client = new Client(t, url), [w, x, y, z] = rotation;
    client.host.ahead(names);
    client.look(position, turned ? [x, w, z, y] : rotation);
    await client.host.start();
    await client.until(() => client.ids.length === scene.records.length && client.complete());
    check(scene, client.batches);
    for (const name of names) assert.equal(asked.filter((each) => each.startsWith(name)).length, 1, name);
  }
});

test("a file asked for ahead that does not come is asked for again", async (t) => {
  const scene = VECTOR.package, lost = new Set(["scene.json"]), { url, asked } = await serve(t, filesOf(scene), (name, _, request) => {
    if (!lost.delete(name)) return false;
    request.socket.destroy();
    return true;
  });
  const client = new Client(t, url);
  client.host.ahead(["scene.json"]);
  client.look(scene.centers![0]);
  await client.host.start();
  await client.until(() => client.ids.length === scene.records.length && client.complete());
  assert.equal(asked.filter((each) => each.startsWith("scene.json")).length, 2);
});

test("a first view that is cut or missing costs the time alone", async (t) => {
  const scene = VECTOR.package, { said } = await open(scene), { position, rotation } = said.first[0].pose;
  for (const cut of [true, false]) {
    const files = filesOf(scene);
    for (const [name, data] of files) {
      if (!name.startsWith("first")) continue;
      if (cut) files.set(name, data.subarray(0, data.length >> 1));
      else files.delete(name);
    }
    const client = new Client(t, (await serve(t, files)).url);
    client.look(position, rotation);
    await client.host.start();
    await client.until(() => client.ids.length === scene.records.length && client.complete());
    check(scene, client.batches);
    assert.match(client.message, /^A part of the scene is missing: first-[0-9a-f]{16}-0\.bin: /);
  }
});

test("pieces of a first view are whole however its bytes come, and it says what it leaves", async () => {
  const { said, file } = await open(VECTOR.package), data = file("first", 0);
  for (const step of [1, 7, data.length]) {
    const view = new FirstView(said, 0), found: Uint8Array[] = [], rows: ChunkRows = new Map();
    for (let at = 0; at < data.length; at += step) found.push(...view.take(data.subarray(at, at + step)));
    const ids = new Set<number>();
    for (const piece of found) (await readPiece(piece, said.header, rows, "first")).ids.forEach((id) => ids.add(id));
    assert.ok(ids.size > 0);
    (await view.left()).forEach((share, p) => {
      assert.ok(share >= 0 && share <= 1);
      if (!VECTOR.package.parts[p].some((id) => ids.has(id))) assert.equal(share, 1);
    });
  }
  const { position, rotation } = said.first[0].pose, view = new FirstView(said, 0), side = said.cells.size;
  assert.ok(view.isFor({ position, rotation }));
  assert.ok(!view.isFor({ position: [position[0] + side, position[1], position[2]], rotation }));
  assert.ok(!view.isFor({ position, rotation: [rotation[1], rotation[0], rotation[3], rotation[2]] }));
});

test("bytes are reported with their rate, which falls to 0 when no more come", async (t) => {
  const { url } = await serve(t, filesOf(VECTOR.package)), clock = new FakeClock();
  const client = new Client(t, url, null, clock);
  client.look(VECTOR.package.centers![0]);
  await client.host.start();
  await client.until(() => client.complete());
  clock.advance(300);
  const busy = client.traffic.at(-1)!;
  assert.ok(busy.bytes > 0 && busy.rate > 0 && busy.gaussians > 0, JSON.stringify(busy));
  clock.advance(5000);
  const last = client.traffic.at(-1)!, reports = client.traffic.length;
  assert.equal(last.rate, 0);
  assert.ok(last.bytes >= busy.bytes);
  clock.advance(60_000);
  assert.equal(client.traffic.length, reports);
});

test("a bare scene has one cell with everything, and harmonics beside its records", async (t) => {
  const { url } = await serve(t, filesOf(VECTOR.bare));
  const client = new Client(t, url);
  client.look([0, 0, -3]);
  await client.host.start();
  await client.until(() => client.complete());
  check(VECTOR.bare, client.batches, client.sets);
  assert.equal(client.ids.length, 150);
});

test("a bare scene that is written for pages nearby comes as arrays", async (t) => {
  const { url } = await serve(t, filesOf(VECTOR.near));
  const client = new Client(t, url);
  client.look([0, 0, -3]);
  await client.host.start();
  await client.until(() => client.complete());
  check(VECTOR.near, client.batches.map(withMeans), client.sets);
  assert.equal(client.ids.length, 150);
});

/** Return a batch with the centers of its Gaussians, which pages nearby find on the GPU alone. */
function withMeans(batch: Batch): Batch {
  const means = new Float32Array(3 * batch.ids.length), layout = recordLayout("rgb");
  assert.equal(batch.means.length, 0);
  batch.ids.forEach((_, i) => decodeMean(batch.records, i, batch.chunks, batch.rows[i] - batch.firstRow, layout, means));
  return { ...batch, means };
}

test("a part for pages nearby that contradicts itself is refused", async () => {
  const { said, file } = await open(VECTOR.near), whole = file("plain", 0), chunks = new DataView(whole.buffer).getUint32(8, true);
  const refuses = (change: (view: DataView) => void, length = whole.length): void => {
    const data = whole.slice(0, length);
    change(new DataView(data.buffer));
    assert.throws(() => new PlainArrivals(said.header).add(data, "part 0"), /part 0: damaged; export the scene again$/);
  };
  assert.equal(new PlainArrivals(said.header).add(whole.slice(), "part 0").harmonics?.sets.length! % 32, 0);
  refuses(() => undefined, 12);
  refuses(() => undefined, whole.length - 4);
  for (const at of [0, 4, 8, 12]) refuses((view) => view.setUint32(at, 1e6, true)); // id, counts, bytes of a set
  refuses((view) => view.setFloat32(16, NaN, true)); // an origin
  refuses((view) => view.setFloat32(16 + 28, 0, true)); // a stride
  refuses((view) => view.setUint32(16 + 32 * chunks, 0, true)); // Gaussians of a chunk
  refuses((view) => view.setUint32(16 + 32 * chunks, 300, true));
  const twice = new PlainArrivals(said.header);
  assert.throws(() => { for (let k = 0; k < 99; k++) twice.add(whole.slice(), "part 0"); }, /damaged/); // too many chunks
});

test("a page that holds its files reads them without a server", async (t) => {
  const held = new Map([...filesOf(VECTOR.bare)].map(([name, data]) => [name, new Blob([new Uint8Array(data)])]));
  const client = new Client(t, "", held);
  client.look([0, 0, -3]);
  await client.host.start();
  await client.until(() => client.complete());
  check(VECTOR.bare, client.batches, client.sets);
});

test("a missing file is named, and the rest is drawn", async (t) => {
  const files = filesOf(VECTOR.package);
  for (const name of [...files.keys()]) if (name.startsWith("terms")) files.delete(name);
  const { url } = await serve(t, files);
  const client = new Client(t, url);
  client.look(VECTOR.package.centers![0]);
  await client.host.start();
  await client.until(() => client.complete());
  check(VECTOR.package, client.batches);
  const last = client.states.at(-1)!;
  assert.ok(
    last.kind === "complete" && /terms-[0-9a-f]{16}-\d+\.bin: the server answers 404/.test(last.message ?? ""),
    JSON.stringify(last),
  );
  assert.ok(client.batches.every((batch) => batch.owners.length === 0));
});

test("a part that is cut, too long or of another content costs only itself", async (t) => {
  for (const change of [
    (data: Buffer) => data.subarray(0, 100), (data: Buffer) => Buffer.concat([data, data]),
    (data: Buffer) => Buffer.alloc(data.length, 7), (data: Buffer) => Buffer.from("<!doctype html>".padEnd(data.length)),
  ]) {
    const files = filesOf(VECTOR.package), name = [...files.keys()].find((each) => /^part-.*-1\.bin/.test(each))!;
    files.set(name, change(files.get(name)!));
    const client = new Client(t, (await serve(t, files)).url), rest = VECTOR.package.parts.filter((_, p) => p !== 1);
    client.look(VECTOR.package.centers![0]);
    await client.host.start();
    await client.until(() => client.ids.length === rest.flat().length && client.complete() && client.message !== "");
    check(VECTOR.package, client.batches);
    assert.match(client.message, /^A part of the scene is missing: part[^\n]*$/);
  }
});

test("a server that errs now and then, or cuts an answer, is asked again", async (t) => {
  const counts = new Map<string, number>();
  const { url } = await serve(t, filesOf(VECTOR.package), (name, data, _, response) => {
    const count = counts.get(name) ?? 0;
    counts.set(name, count + 1);
    if (count === 0) response.writeHead(503).end();
    else if (
      count === 1 && data !== undefined && name !== "scene.json"
    ) response.writeHead(200).end(data.subarray(0, 3));
    else return false;
    return true;
  });
  const client = new Client(t, url);
  client.look(VECTOR.package.centers![0]);
  await client.host.start();
  await client.until(() => client.complete());
  check(VECTOR.package, client.batches);
});

test("a link that is down is waited for", async (t) => {
  let refused = 0;
  const { url } = await serve(t, filesOf(VECTOR.bare), (name, _, request) => {
    if (!name.startsWith("part") || refused++ > 5) return false;
    request.socket.destroy();
    return true;
  });
  const client = new Client(t, url);
  client.look([0, 0, -3]);
  await client.host.start();
  await client.until(() => client.complete());
  assert.ok(client.states.some((state) => state.kind === "waiting"));
  assert.equal(client.ids.length, 150);
});

test("a site written anew under the same address is read anew", async (t) => {
  const files = filesOf(VECTOR.package), other = filesOf(VECTOR.bare);
  for (const name of [...files.keys()]) if (/^(part|glance)/.test(name)) files.delete(name);
  let asked = 0;
  const { url } = await serve(t, files, (name, _, __, response) => {
    if (name === "scene.json" && asked++ > 0) {
      for (const [each, data] of other) files.set(each, data);
      response.writeHead(200).end(other.get(name));
      return true;
    }
    return false;
  });
  const client = new Client(t, url);
  client.look([0, 0, -3]);
  await client.host.start();
  await client.until(() => client.headers === 2 && client.ids.length === 150 && client.complete());
});

test("what is no scene, or of a newer version, is said in one line", async (t) => {
  const scene = JSON.parse(filesOf(VECTOR.bare).get("scene.json")!.toString()) as Record<string, unknown>;
  const wrong: [string, RegExp][] = [
    ["<html>", /expected JSON/], ["{}", /expected a static scene/],
    [JSON.stringify({ ...scene, version: 9 }), /version 8, got 9; export/],
    [JSON.stringify({ ...scene, version: 7 }), /version 8, got 7; export/],
    [JSON.stringify({ ...scene, files: { index: { name: "../secret.bin", bytes: 1, count: 1 } } }), /name without a path/],
    [JSON.stringify({ ...scene, parts: 3 }), /files, part: expected 3 files/],
    [JSON.stringify({ ...scene, gaussians: -1 }), /scene.json, gaussians: expected a number from 0 to/],
    [JSON.stringify({ ...scene, chunks: 2 ** 40 }), /scene.json, chunks: expected a number from 0 to/],
    [JSON.stringify({ ...scene, levels: [] }), /levels/],
  ];
  for (const [text, message] of wrong) {
    assert.throws(() => parseScene(text), message);
    const { url } = await serve(t, new Map([["scene.json", Buffer.from(text)]]));
    const client = new Client(t, url);
    await client.host.start();
    const last = client.states.at(-1)!;
    assert.ok(
      last.kind === "failed" && message.test(last.message) && !last.message.includes("\n"), JSON.stringify(last),
    );
  }
});

/** Return what scene.json says, and a file or one of a kind by its number. */
async function open(scene: Recorded): Promise<{ said: StaticScene; file: (kind: string, number?: number) => Uint8Array }> {
  const files = filesOf(scene), said = parseScene(files.get("scene.json")!.toString());
  const file = (kind: string, number?: number): Uint8Array => {
    const { name } = said.files.get(kind)!;
    return new Uint8Array(files.get(number === undefined ? name : `${name}-${number}.bin`)!);
  };
  return { said, file };
}

test("parts, cells and gains are those of the writer", async () => {
  for (const scene of [VECTOR.package, VECTOR.bare]) {
    const { said, file } = await open(scene), index = await Index.open(said, file("index"));
    const cells = await Cells.open(said, file("grid"));
    assert.deepEqual([...index.sizes], scene.parts.map((ids) => ids.length));
    for (const [p, ids] of scene.parts.entries()) {
      assert.equal(index.bytes[p], file("part", p).length);
      const piece = await readPiece(file("part", p), said.header, new Map(), "part");
      assert.deepEqual([...piece.ids], ids);
    }
    for (const [cell, wanted] of scene.cells.entries()) {
      const row = await readRow(said, file("row", cell), cells.middle(cell));
      wanted.gains.forEach((gain, k) => assert.ok(Math.abs(row.gains[k] - gain) <= 1e-5 * gain + 1e-6));
      wanted.spheres.forEach((sphere, p) => {
        sphereOf(index, row, p).forEach((v, k) => assert.ok(Math.abs(v - sphere[k]) <= 1e-5 * Math.abs(sphere[k]) + 1e-5));
      });
    }
    scene.centers?.forEach((center, cell) => assert.equal(cells.at(center), cell));
  }
});

test("what comes again is left out of a batch", async () => {
  const { said, file } = await open(VECTOR.package), arrivals = new Arrivals(said.header);
  const pieces = [await readPiece(file("part", 0), said.header, arrivals.rows, "part")];
  pieces.push(await readPiece(file("part", 1), said.header, arrivals.rows, "part"));
  const first = arrivals.add(pieces[0]), again = arrivals.add(pieces[0]), second = arrivals.add(pieces[1]);
  assert.deepEqual([first.ids.length, again.ids.length], [pieces[0].ids.length, 0]);
  assert.equal(second.first, first.ids.length);
  assert.equal(second.firstRow, first.chunks.length / 8);
});

test("the piece of a scene is refused whichever byte of its head is changed, or draws only what the scene has", async () => {
  const { said, file } = await open(VECTOR.package), whole = file("part", 0);
  for (let at = 0; at < 24; at++) {
    const data = whole.slice();
    data[at] ^= 0x55;
    await assert.rejects(readPiece(data, said.header, new Map(), "part 0"), /part 0/);
  }
});

test("the plan takes what has most light in view for its bytes and its delay", async () => {
  const scene = VECTOR.package, { said, file } = await open(scene), index = await Index.open(said, file("index"));
  const cells = await Cells.open(said, file("grid")), row = await readRow(said, file("row", 0), cells.middle(0));
  const position = scene.centers![0] as [number, number, number], pose: Pose = { position, rotation: [1, 0, 0, 0] };
  const worth = worthOf(index, row, said.cells.size, pose, VIEW), planes = frustum(pose, VIEW);
  const held = (): Holdings => ({
    part: new Uint8Array(index.count), terms: new Uint8Array(index.count), sets: new Uint8Array(0),
    glance: new Uint8Array(0), left: new Float32Array(index.count).fill(1),
  });
  const pick = (has: Holdings, delay: number, blocks: SetBlocks = { bytes: [], worth: [] }): Choice | null =>
    choose(index, worth, row.terms, has, delay, blocks);
  for (let p = 0; p < index.count; p++) {
    if (row.gains[p] === 0) continue;
    const [low, high] = [sphereOf(index, row, p), sphereOf(index, null, p)].map((sphere) => insideOf(planes, ...sphere)).sort((a, b) => a - b);
    const share = (worth[p] / row.gains[p] - 0.0003) / 0.9997;
    assert.ok(share >= low - 1e-5 && share <= high + 1e-5);
    const [x, y, z, radius] = sphereOf(index, row, p);
    const depth = Math.min(...[0, 4, 8, 12, 16].map((k) => planes[k] * x + planes[k + 1] * y + planes[k + 2] * z + planes[k + 3]));
    const away = Math.sqrt(3) * depth / radius, inside = insideOf(planes, x, y, z, radius);
    assert.ok(Math.abs(away) < 3 || Math.abs(inside - Number(away > 0)) < 0.002); // three deviations from the border
    assert.equal(inside > 0.5, away > 0);
  }
  const best = pick(held(), 0)!.number;
  for (let p = 0; p < index.count; p++) {
    assert.ok(worth[best] / index.bytes[best] >= worth[p] / index.bytes[p] * (1 - 1e-6));
  }
  const slow = pick(held(), 1e9)!.number;
  for (let p = 0; p < index.count; p++) assert.ok(worth[slow] >= worth[p] * (1 - 1e-4));
  const all = held();
  all.part.fill(HELD);
  assert.equal(pick(all, 0)!.kind, "terms");
  all.terms.fill(HELD);
  assert.equal(pick(all, 0), null);
  all.sets = Uint8Array.of(HELD, NONE, NONE);
  assert.deepEqual(pick(all, 0, { bytes: [9, 9, 9], worth: [1, 0.1, 0.01] }), { kind: "sets", number: 1 });
  all.sets.fill(HELD);
  all.part[2] = NONE;
  worth.fill(0);
  assert.equal(pick(all, 0), null);
});

test("outside of its cell an eye sees also what the cell does not, the more the farther it is", async () => {
  const { said, file } = await open(VECTOR.package), index = await Index.open(said, file("index"));
  const cells = await Cells.open(said, file("grid")), middle = cells.middle(0)!, { size } = said.cells;
  const blind = { gains: new Float32Array(index.count), terms: null, middle, spheres: null, glances: new Uint32Array(0) };
  const at = (sides: number): Float32Array => worthOf(
    index, blind, size, { position: [middle[0] + sides * size, middle[1], middle[2]], rotation: [1, 0, 0, 0] }, VIEW,
  );
  assert.ok(at(0.49).every((worth) => worth === 0));
  assert.ok([at(0.6), at(30)].every((worths) => worths.every((worth) => worth > 0 && Number.isFinite(worth))));
});

test("a part that is nearer to the eye than to the middle of its cell is worth more", async () => {
  const { said, file } = await open(VECTOR.package), index = await Index.open(said, file("index"));
  const [x, y, z] = index.spheres, { size } = said.cells, middle = [x, y, z - 3 * size];
  const row = { gains: new Float32Array(index.count).fill(1), terms: null, middle, spheres: null, glances: new Uint32Array(0) };
  const at = (away: number): number => worthOf(
    index, row, size, { position: [x, y, middle[2] + away * size], rotation: [1, 0, 0, 0] }, VIEW,
  )[0];
  assert.ok(at(0.4) > at(0) && at(0) > at(-0.4));
});

test("frusta are those of the server", () => {
  const planes = frustum({ position: [1, 2, 3], rotation: [1, 0, 0, 0] }, VIEW);
  const distance = (x: number, y: number, z: number): number => Math.min(
    ...[0, 4, 8, 12, 16].map((k) => planes[k] * x + planes[k + 1] * y + planes[k + 2] * z + planes[k + 3]),
  );
  assert.ok(distance(1, 2, 5) > 0);
  assert.ok(distance(1, 2, 2) < 0);
  assert.ok(distance(3.5, 2, 5) < 0 && distance(2.5, 2, 5) > 0);
});

test("addresses of scenes", () => {
  const page = "https://example.org/site/index.html";
  assert.equal(baseOf("scene", page), "https://example.org/site/scene/");
  assert.equal(baseOf("scene/", page), "https://example.org/site/scene/");
  assert.equal(baseOf("scene/scene.json", page), "https://example.org/site/scene/scene.json");
  assert.equal(baseOf("inline:", page), "inline:");
  assert.equal(baseOf("javascript:alert(1)", page), null);
  assert.equal(baseOf("http://[", page), null);
});
