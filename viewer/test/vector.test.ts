// The recorded exchange of tests/stream/vector.json: the client of the record, from its bytes alone.
import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { join } from "node:path";
import { test } from "node:test";
import { Receiver } from "../src/core/receiver.ts";
import { colorSeen, decodeRecord, decodeTerm, tablesOf } from "../src/core/tables.ts";
import type { Splat, Term } from "../src/core/tables.ts";
import type { Batch } from "../src/core/types.ts";
import { ack, bye, hello, poseAt } from "../src/core/wire.ts";

interface Step { from: string; bytes: string; gaussians?: number[]; terms?: number[]; dropped?: number[]; gone?: number[] }
interface Vector { eye: [number, number, number]; steps: Step[]; drawn: Record<string, number[] | number[][]> }

const vector = JSON.parse(readFileSync(join(process.cwd(), "../tests/stream/vector.json"), "utf8")) as Vector;
const bytesOf = (step: Step) => new Uint8Array(Buffer.from(step.bytes, "hex"));
const isBatch = (step: Step) => step.from === "server" && step.gaussians !== undefined;

/** Play the record; call `each` with every batch. */
function play(each: (batch: Batch, step: Step) => void): Receiver {
  let receiver: Receiver | null = null;
  for (const step of vector.steps.filter((step) => step.from === "server")) {
    const bytes = bytesOf(step);
    if (isBatch(step)) each((receiver as Receiver).receive(bytes), step);
    else if (receiver === null) receiver = new Receiver(bytes);
    else assert.ok(receiver.resume(bytes));
  }
  return receiver as Receiver;
}

test("a client of the record receives what it says", () => {
  const ids: number[] = [];
  play((batch, step) => {
    assert.equal(batch.first, ids.length);
    ids.push(...batch.ids);
    assert.deepEqual([...batch.ids], step.gaussians);
    assert.deepEqual([...batch.gone].map((slot) => ids[slot]), step.dropped);
    assert.equal(batch.terms.length, 2 * (step.terms as number[]).length);
    assert.ok([...batch.owners].every((slot) => slot < ids.length));
  });
});

test("a client of the record draws what it says", () => {
  const splats: { id: number; splat: Splat; terms: Term[] }[] = [], chunks: number[] = [], dropped = new Set<number>();
  let receiver: Receiver | null = null;
  let means: number[] = [];
  receiver = play((batch) => {
    chunks.push(...batch.chunks);
    means = [...means, ...batch.means];
    const tables = tablesOf((receiver ?? new Receiver(bytesOf(vector.steps[1]))).about.colors);
    const table = Float32Array.from(chunks);
    batch.ids.forEach((id, i) => splats.push({ id, splat: decodeRecord(batch.records, i, table, batch.rows[i], tables), terms: [] }));
    batch.owners.forEach((slot, i) => splats[slot].terms.push(decodeTerm(batch.terms, i, tables)));
    batch.gone.forEach((slot) => dropped.add(slot));
  });
  splats.forEach(({ splat }, slot) => assert.deepEqual(splat.mean, means.slice(3 * slot, 3 * slot + 3)));
  const drawn = splats.filter((_, slot) => !dropped.has(slot)).sort((a, b) => a.id - b.id);
  assert.deepEqual(drawn.map(({ id }) => id), vector.drawn["ids"]);
  const found: Record<string, number[][]> = {
    means: drawn.map(({ splat }) => splat.mean), quats: drawn.map(({ splat }) => splat.quat), scales: drawn.map(({ splat }) => splat.scale),
    opacities: drawn.map(({ splat }) => [splat.opacity]),
    rgb: drawn.map(({ splat, terms }) => colorSeen(splat, terms, vector.eye, receiver.about.colors.variant)),
  };
  for (const [name, rows] of Object.entries(found)) {
    const expected = (vector.drawn[name] as number[][]).flat();
    rows.flat().forEach((value, k) => assert.ok(Math.abs(value - expected[k]) < 1e-6, `${name} ${k}: ${value}, not ${expected[k]}`));
    assert.equal(rows.flat().length, expected.length);
  }
});

test("a client says the bytes of the record", () => {
  const said = vector.steps.filter((step) => step.from === "client").map((step) => step.bytes);
  const hex = (bytes: Uint8Array) => Buffer.from(bytes).toString("hex");
  const view = { left: 1, right: 1, up: 0.75, down: 0.75 }, reach = { margin: 0.125, near: 0.0625 };
  const pose = (k: number) => poseAt(100 * k, { position: [1.5 * k - 1.5, -1, 0.25], rotation: [1, 0, 0.25 * k, 0] });
  let batches = 0, resumed = "";
  const first = new Receiver(bytesOf(vector.steps[1]));
  for (const step of vector.steps.filter(isBatch).slice(0, 2)) first.receive(bytesOf(step));
  resumed = hex(hello(view, reach, first.about.identity, first.holdings()));
  const expected = [hello(view, reach), ack(0), pose(0), ack(1), pose(1), ack(2)].map(hex);
  assert.deepEqual(said.slice(0, 6), expected);
  assert.equal(said[6], resumed);
  assert.deepEqual(said.slice(-3), [hex(pose(2)), hex(ack(1)), hex(bye())]);
  batches = vector.steps.filter(isBatch).length;
  assert.equal(batches, 3);
});
