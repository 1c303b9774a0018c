// Static scenes over a small HTTP server: all that a cell needs arrives; servers without ranges, cuts, gaps and outages
// are gone round.
import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { createServer, type IncomingMessage, type ServerResponse } from "node:http";
import type { AddressInfo } from "node:net";
import { join } from "node:path";
import { deflateSync, inflateSync } from "node:zlib";
import { test, type TestContext } from "node:test";
import { Arrivals } from "../src/core/static-arrivals.ts";
import { Blocks } from "../src/core/static-blocks.ts";
import { StaticHost } from "../src/core/static-host.ts";
import type { Report } from "../src/core/worker-source.ts";
import { HeldParts, HttpParts } from "../src/core/static-parts.ts";
import { HELD, frustum, rank, regimeOf, slice, widen } from "../src/core/static-plan.ts";
import { Cells, readRow } from "../src/core/static-cells.ts";
import { parseScene } from "../src/core/static-scene.ts";
import { baseOf } from "../src/core/static-source.ts";
import { type Clock, REAL_TIME } from "../src/core/traffic.ts";
import type { Batch, Pose, SourceState, Traffic, View } from "../src/core/types.ts";
import { FakeClock } from "./fakes.ts";

interface Recorded {
  files: Record<string, string>;
  records: string[];
  means: number[][];
  blocks: [number, number, number][];
  cells: { blocks: number[]; gains: number[] }[];
  terms?: string[][]; // sorted
  centers?: number[][];
  last?: number[];
  harmonics?: string[];
}

const VECTOR = JSON.parse(
  readFileSync(join(import.meta.dirname, "../../tests/export/vector.json"), "utf8")
) as { package: Recorded; bare: Recorded };
const VIEW: View = { left: 1, right: 1, up: 1, down: 1 };

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
  readonly traffic: Traffic[] = [];
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
    else if (report.kind === "header") this.headers++;
    else this.traffic.push(report.traffic);
    for (const listener of this.listeners) listener();
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

  get ids(): number[] {
    return this.batches.flatMap((batch) => [...batch.ids]);
  }
}

/**
 * Check that what came is what the scene holds, and that slots, rows and terms are numbered in the order of arrival.
 */
function check(scene: Recorded, batches: Batch[]): void {
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
        assert.equal(Buffer.from(batch.harmonics!.subarray(24 * i, 24 * i + 24)).toString("hex"), scene.harmonics[id]);
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
    const left = [...scene.terms![id]]; // those of layers that no eye in the cell sees do not come
    for (const record of found) {
      assert.ok(left.includes(record));
      left.splice(left.indexOf(record), 1);
    }
  }
}

test("all that a cell needs arrives, in the order of arrival, and what its neighbors see after it", async (t) => {
  const { url } = await serve(t, filesOf(VECTOR.package));
  const client = new Client(t, url), scene = VECTOR.package;
  client.look(scene.centers![0]);
  await client.host.start();
  await client.until(() => client.complete());
  check(scene, client.batches);
  const wanted = scene.cells[0].blocks.map((b) => scene.blocks[b]).filter(([, first]) => scene.last![first] === 2);
  const held = new Set(client.ids);
  for (const [, first, count] of wanted) {
    for (let id = first; id < first + count; id++) {
      assert.ok(
        held.has(id), `Gaussian ${id} is missing`,
      );
    }
  }
  assert.ok(client.batches.some((batch) => batch.owners.length > 0));
  assert.deepEqual(client.states.map((state) => state.kind), ["connecting", "streaming", "complete"]);
  assert.equal(client.headers, 1);
});

/** Return the files of a scene whose cells do not see the odd blocks. */
function blind(files: Map<string, Buffer>): Map<string, Buffer> {
  const scene = JSON.parse(files.get("scene.json")!.toString()) as {
    blocks: number; files: Record<string, { name: string; bytes: number }>; cells: { count: number };
  };
  const { blocks, cells: { count } } = scene, whole = (kind: string): Buffer => files.get(scene.files[kind].name)!;
  const grid = inflateSync(whole("grid")), bits = Math.ceil(blocks / 8), rows: Buffer[] = [];
  for (let cell = 0, start = 0; cell < count; cell++) {
    const size = (k: number): number => (12 + k) * count + cell; // byte k of the size of its row
    const end = start + [0, 1, 2, 3].reduce((sum, k) => sum + grid[size(k)] * 256 ** k, 0);
    const row = inflateSync(whole("cells").subarray(start, end)), kept: number[] = [];
    const seen = Array.from({ length: blocks }, (_, b) => b).filter((b) => (row[b >> 3] >> (b & 7)) & 1);
    row.subarray(bits).forEach((value, k) => { if (seen[k % seen.length] % 2 === 0) kept.push(value); });
    const made = deflateSync(Buffer.from([...row.subarray(0, bits)].map((byte) => byte & 0x55).concat(kept)));
    for (let k = 0; k < 4; k++) grid[size(k)] = (made.length >> (8 * k)) & 255;
    rows.push(made);
    start = end;
  }
  const found = new Map(files);
  for (const [kind, data] of [["grid", deflateSync(grid)], ["cells", Buffer.concat(rows)]] as const) {
    found.set(scene.files[kind].name, data);
    scene.files[kind].bytes = data.length;
  }
  return found.set("scene.json", Buffer.from(JSON.stringify(scene)));
}

test("an idle link ends with every record of the highest level, once, wherever the eye is", async (t) => {
  const scene = VECTOR.package, { size } = (await open(scene)).blocks.scene.cells, [x, y, z] = scene.centers![0];
  const wanted = scene.last!.flatMap((last, id) => last === 2 ? [id] : []);
  const terms = wanted.reduce((sum, id) => sum + scene.terms![id].length, 0);
  for (const away of [0, 0.8, 50]) {
    const { url } = await serve(t, blind(filesOf(scene))), client = new Client(t, url);
    client.look([x + away * size, y, z]);
    await client.host.start();
    await client.until(() => {
      const { batches, ids } = client, held = new Set(ids), gone = new Set(batches.flatMap((batch) => [...batch.gone]));
      const owners = batches.flatMap((batch) => [...batch.owners]).filter((slot) => scene.last![ids[slot]] === 2);
      return wanted.every((id) => held.has(id)) && owners.length === terms &&
        ids.every((id, slot) => scene.last![id] === 2 || gone.has(slot));
    });
    check(scene, client.batches);
  }
});

test("a row is widened outside of its cell alone, the more the farther the eye is", async () => {
  const { blocks, file, cells } = await open(VECTOR.package), { size } = blocks.scene.cells, middle = cells.middle(0)!;
  const whole = await readRow(blocks.scene, file("cells").subarray(...cells.range(0)), middle);
  const some = whole.blocks.map((_, k) => k).filter((k) => k % 3 > 0), each = whole.blocks.length;
  const row = {
    middle, blocks: some.map((k) => whole.blocks[k]), gains: Float32Array.from(some, (k) => whole.gains[k]),
    items: whole.items!.filter((_, k) => (k % each) % 3 > 0),
  };
  const at = (sides: number): number[] => middle.map((v, axis) => axis === 0 ? v + sides * size : v);
  assert.equal(widen(blocks, row, size, at(0.49)), row);
  const [near, far] = [0.6, 30].map((sides) => widen(blocks, row, size, at(sides)));
  const own = new Map([...row.blocks].map((b, k) => [b, k]));
  assert.ok(own.size < blocks.count);
  for (const [b, gain] of far.gains.entries()) {
    const k = own.get(b);
    if (k === undefined) assert.ok(near.gains[b] < gain && Number.isFinite(near.gains[b]));
    else assert.deepEqual([near.gains[b], gain], [row.gains[k], row.gains[k]]);
    for (let layer = 0; layer < blocks.scene.layers; layer++) {
      const item = near.items![layer * blocks.count + b];
      if (k === undefined) assert.ok(item < near.gains[b]);
      else assert.equal(item, row.items![layer * own.size + k]);
    }
  }
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
  check(VECTOR.bare, client.batches);
  assert.equal(client.ids.length, 150);
});

test("a server without ranges sends each file once", async (t) => {
  const { url, asked } = await serve(t, filesOf(VECTOR.package), (_, data, __, response) => {
    if (data === undefined) return false;
    response.writeHead(200).end(data);
    return true;
  });
  const client = new Client(t, url);
  client.look(VECTOR.package.centers![0]);
  await client.host.start();
  await client.until(() => client.complete());
  check(VECTOR.package, client.batches);
  const names = asked.map((each) => each.split(" ")[0]);
  assert.equal(new Set(names).size, names.length, asked.join("\n"));
});

test("a page that holds its files reads them without a server", async (t) => {
  const held = new Map([...filesOf(VECTOR.bare)].map(([name, data]) => [name, new Blob([new Uint8Array(data)])]));
  const client = new Client(t, "", held);
  client.look([0, 0, -3]);
  await client.host.start();
  await client.until(() => client.complete());
  check(VECTOR.bare, client.batches);
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
    last.kind === "complete" && /terms-[0-9a-f]{16}\.bin: the server answers 404/.test(last.message ?? ""),
    JSON.stringify(last),
  );
  assert.ok(client.batches.every((batch) => batch.owners.length === 0));
});

test("a cut file gives what is there of it", async (t) => {
  const files = filesOf(VECTOR.bare);
  for (const [name, data] of files) if (name.startsWith("records")) files.set(name, data.subarray(0, 1200));
  const { url } = await serve(t, files);
  const client = new Client(t, url);
  client.look([0, 0, -3]);
  await client.host.start();
  await client.until(() => client.complete());
  check(VECTOR.bare, client.batches);
  assert.deepEqual(client.ids.length, 64); // the first block; the second is cut
  const last = client.states.at(-1)!;
  assert.ok(last.kind === "complete" && /records-/.test(last.message ?? ""), JSON.stringify(last));
});

test("a block whose terms or replacements make no sense costs only itself", async (t) => {
  for (const kind of ["terms", "records"]) {
    const files = filesOf(VECTOR.package), { blocks } = await open(VECTOR.package),
      name = [...files.keys()].find((each) => each.startsWith(kind))!;
    const data = Buffer.from(files.get(name)!);
    const ending = [...Array(blocks.count).keys()].filter((b) => blocks.last(b) < blocks.top);
    const [lost] = ending, start = blocks.recordStart[lost], behind = start + 32 + 2 * data.readUInt16LE(start + 28);
    if (kind === "terms") data[0] ^= 1;
    else data.fill(255, behind, blocks.recordStart[lost + 1]);
    files.set(name, data);
    const { url } = await serve(t, files);
    const client = new Client(t, url), scene = VECTOR.package;
    client.look(scene.centers![0]);
    await client.host.start();
    await client.until(() => client.complete());
    check(scene, client.batches);
    const held = new Set(client.ids),
      owned = new Set(client.batches.flatMap((batch) => [...batch.owners].map((slot) => client.ids[slot])));
    const wanted = scene.cells[0].blocks.filter((b) => blocks.last(b) === blocks.top);
    for (const b of wanted) assert.ok(held.has(blocks.firstId[b]), `block ${b} is missing`);
    assert.ok(owned.size > 0);
    const last = client.states.at(-1)!;
    assert.ok(last.kind === "complete" && last.message?.includes(`${kind}: block`), JSON.stringify(last));
  }
});

test("a server that errs now and then, or cuts an answer, is asked again", async (t) => {
  const counts = new Map<string, number>();
  const { url } = await serve(t, filesOf(VECTOR.package), (name, data, request, response) => {
    const key = `${name} ${request.headers.range ?? ""}`, count = counts.get(key) ?? 0;
    counts.set(key, count + 1);
    if (count === 0) response.writeHead(503).end();
    else if (
      count === 1 && data !== undefined && name !== "scene.json"
    ) response.writeHead(206).end(data.subarray(0, 3));
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
    if (!name.startsWith("records") || refused++ > 5) return false;
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
  for (const name of [...files.keys()]) if (name.startsWith("records")) files.delete(name);
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
  await client.until(() => client.headers === 2 && client.complete());
  assert.equal(client.ids.length, 150);
});

test("what is no scene, or of a newer version, is said in one line", async (t) => {
  const scene = JSON.parse(filesOf(VECTOR.bare).get("scene.json")!.toString()) as Record<string, unknown>;
  const wrong: [string, RegExp][] = [
    ["<html>", /expected JSON/], ["{}", /expected a static scene/],
    [JSON.stringify({ ...scene, version: 4 }), /version 3, got 4; export/],
    [JSON.stringify({ ...scene, version: 2 }), /version 3, got 2; export/],
    [JSON.stringify({ ...scene, files: { records: { name: "../secret.bin", bytes: 1 } } }), /name without a path/],
    [JSON.stringify({ ...scene, gaussians: 151 }), /expected 3624 bytes/],
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

async function open(scene: Recorded): Promise<{ blocks: Blocks; file: (kind: string) => Uint8Array; cells: Cells }> {
  const files = filesOf(scene), said = parseScene(files.get("scene.json")!.toString());
  const file = (kind: string): Uint8Array => new Uint8Array(files.get(said.files.get(kind)!.name)!);
  const [blocks, cells] = [await Blocks.open(said, file("index")), await Cells.open(said, file("grid"))];
  return { blocks, file, cells };
}

test("blocks, cells and gains are those of the writer", async () => {
  for (const scene of [VECTOR.package, VECTOR.bare]) {
    const { blocks, file, cells } = await open(scene);
    assert.deepEqual(scene.blocks, scene.blocks.map((_, b) => [blocks.chunk[b], blocks.firstId[b], blocks.size(b)]));
    for (const [cell, said] of scene.cells.entries()) {
      const row = await readRow(blocks.scene, file("cells").subarray(...cells.range(cell)), cells.middle(cell));
      assert.deepEqual([...row.blocks], said.blocks);
      row.gains.forEach((gain: number, k: number) => assert.ok(Math.abs(gain - said.gains[k]) < 1e-5));
    }
    scene.centers?.forEach((center, cell) => assert.equal(cells.at(center), cell));
  }
});

test("a Gaussian that ends below the highest level goes when what replaces it is held, and not before", async () => {
  const { blocks, file } = await open(VECTOR.package);
  const held = { records: new Uint8Array(blocks.count), terms: new Uint8Array(0) };
  const arrivals = new Arrivals(blocks, held), records = file("records"), seen = new Uint8Array(blocks.count).fill(1);
  let waiting = 0;
  for (let b = 0; b < blocks.count; b++) {
    if (blocks.last(b) === blocks.top) continue;
    take(arrivals, blocks, records, b);
    waiting += blocks.size(b);
  }
  const early = arrivals.sweep(seen)?.gone.length ?? 0; // replaced by others that end too
  for (let b = 0; b < blocks.count; b++) if (held.records[b] !== HELD) take(arrivals, blocks, records, b);
  const late = arrivals.sweep(seen)?.gone.length ?? 0;
  assert.ok(late > 0);
  assert.equal(early + late, waiting);
  assert.equal(arrivals.sweep(seen), null);
});

function take(arrivals: Arrivals, blocks: Blocks, records: Uint8Array, b: number): void {
  arrivals.addRecords(
    { terms: false, first: b, end: b + 1, place: 0 },
    records.subarray(blocks.recordStart[b], blocks.recordStart[b + 1]), null, (error) => assert.fail(String(error)),
  );
}

test("a cell that has all of its highest level waits neither for lower levels nor for what is out of sight", async () => {
  const { blocks, file } = await open(VECTOR.package);
  const held = { records: new Uint8Array(blocks.count), terms: new Uint8Array(0) };
  const arrivals = new Arrivals(blocks, held), seen = new Uint8Array(blocks.count);
  const ending = Array.from({ length: blocks.count }, (_, b) => b).filter((b) => blocks.last(b) < blocks.top);
  const [b] = ending;
  take(arrivals, blocks, file("records"), b);
  assert.equal(arrivals.sweep(seen, true), null); // of another cell: it stays
  for (const other of ending) seen[other] = 1;
  assert.equal(arrivals.sweep(seen), null);
  assert.equal(arrivals.sweep(seen, true)?.gone.length, blocks.size(b));
});

test("layers of terms are asked for where their terms count in the cell, neighbors in the file together", async () => {
  const { blocks, file, cells } = await open(VECTOR.package), { layers } = blocks.scene;
  await blocks.setTerms(file("blocks"));
  const held = { records: new Uint8Array(blocks.count).fill(HELD), terms: new Uint8Array(layers * blocks.count) };
  const position = VECTOR.package.centers![0] as [number, number, number];
  const row = await readRow(blocks.scene, file("cells").subarray(...cells.range(0)), cells.middle(0));
  const wanted = new Set<number>();
  row.blocks.forEach((b, k) => {
    for (let layer = 0; layer < layers; layer++) {
      const item = layer * blocks.count + b;
      if (row.items![layer * row.blocks.length + k] > -Infinity && blocks.bytes(item, item + 1, true) > 0) wanted.add(item);
    }
  });
  const order = rank(blocks, row, held, { position, rotation: [1, 0, 0, 0] }, VIEW, "low");
  assert.ok(order.terms.every((kind) => kind === 1));
  assert.deepEqual(new Set(order.blocks), wanted);
  assert.ok(wanted.size < row.blocks.length * layers);
  for (const run of slice(blocks, order, 0, held, Infinity, 0).runs) {
    for (let item = run.first; item < run.end; item++) assert.ok(wanted.has(item));
    assert.equal(blocks.bytes(run.first, run.end, true), blocks.termStart![run.end] - blocks.termStart![run.first]);
  }
});

test("the plan begins with what weighs most in view for its bytes, and joins neighbors", async () => {
  const { blocks, file, cells } = await open(VECTOR.package);
  const row = await readRow(blocks.scene, file("cells").subarray(...cells.range(0)), cells.middle(0));
  const held = { records: new Uint8Array(blocks.count), terms: new Uint8Array(0) };
  const position = VECTOR.package.centers![0] as [number, number, number];
  const order = rank(blocks, row, held, { position, rotation: [1, 0, 0, 0] }, VIEW, "high");
  assert.equal(new Set(order.blocks).size, order.blocks.length);
  const all = slice(blocks, order, 0, held, Infinity, Infinity);
  assert.equal(all.next, order.blocks.length);
  for (const run of all.runs) assert.ok(run.end > run.first);
  assert.deepEqual(slice(blocks, order, 0, held, Infinity, 0).runs, []); // all is asked for
  const apart = { records: new Uint8Array(blocks.count), terms: new Uint8Array(blocks.count) };
  const runs = slice(blocks, order, 0, apart, Infinity, 0).runs;
  assert.ok(runs.length >= all.runs.length);
  assert.equal(runs.reduce((sum, run) => sum + run.end - run.first, 0), order.blocks.length);
});

test("a first picture is not asked for, and the level above it counts as the lowest", async () => {
  const { blocks, file, cells } = await open(VECTOR.package), { header } = blocks.scene;
  const row = await readRow(blocks.scene, file("cells").subarray(...cells.range(0)), cells.middle(0));
  const held = { records: new Uint8Array(blocks.count), terms: new Uint8Array(blocks.count) };
  const pose: Pose = { position: VECTOR.package.centers![0] as [number, number, number], rotation: [1, 0, 0, 0] };
  const lasts = (of: Blocks): Set<number> =>
    new Set([...rank(of, row, held, pose, VIEW, "low").blocks].map((b) => of.last(b)));
  const some = lasts(blocks), few = header.levels.map((level, k) => (k === 0 ? { ...level, count: 1 } : level));
  assert.ok(some.has(0));
  const reopen = async (index: Uint8Array): Promise<Blocks> =>
    Blocks.open({ ...blocks.scene, header: { ...header, levels: few } }, index);
  const index = new Uint8Array(inflateSync(file("index"))), last = 12 * header.chunks;
  assert.deepEqual([blocks.lowest, (await reopen(file("index"))).lowest], [0, 0]); // it shares chunks
  for (let k = 0; k < header.chunks; k++) if (blocks.levels[2 * k] === 0) index[last + k] = 0; // none any more
  const other = await reopen(new Uint8Array(deflateSync(index)));
  assert.equal(other.lowest, 1);
  const others = lasts(other);
  assert.ok(!others.has(0) && others.size > 0);
});

test("frusta and regimes are those of the server", () => {
  const planes = frustum({ position: [1, 2, 3], rotation: [1, 0, 0, 0] }, VIEW, 0);
  const distance = (x: number, y: number, z: number): number => Math.min(
    ...[0, 4, 8, 12, 16].map((k) => planes[k] * x + planes[k + 1] * y + planes[k + 2] * z + planes[k + 3]),
  );
  assert.ok(distance(1, 2, 5) > 0);
  assert.ok(distance(1, 2, 2) < 0);
  assert.ok(distance(3.5, 2, 5) < 0 && distance(2.5, 2, 5) > 0);
  assert.equal(regimeOf(1e6, [1e6, 2e6, 3e6], null), "high");
  assert.equal(regimeOf(0.7e6, [1e6, 2e6, 3e6], null), "medium");
  assert.equal(regimeOf(0.1e6, [1e6, 2e6, 3e6], null), "low");
  assert.equal(regimeOf(0.99e6, [1e6, 2e6, 3e6], "high"), "high");
  assert.equal(regimeOf(1.01e6, [1e6, 2e6, 3e6], "medium"), "medium");
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
