// The recorded exchanges of tests/stream: the clients of the records, from their bytes alone.
import assert from "node:assert/strict";
import { test } from "node:test";
import { Receiver } from "../src/core/receiver.ts";
import { colorSeen, decodeRecord, decodeTerm, tablesOf } from "../src/core/tables.ts";
import type { Splat, Term } from "../src/core/tables.ts";
import type { Batch } from "../src/core/types.ts";
import { readCodes, wordsOf } from "../src/core/bits.ts";
import { bytesOf, changed, evicting, hex, isBatch, vector } from "./fakes.ts";
import type { Step, Vector } from "./fakes.ts";
import { ack, bye, hello, poseAt } from "../src/core/wire.ts";

/** Return a batch that brings the rows of another's chunks, and nothing else. */
function chunksAlone(batch: Uint8Array, sequence: number): Uint8Array {
  const at = 8 + 160 + 24, before = new DataView(batch.buffer, 8 + 160), second = before.getInt32(8, true);
  const ids = batch.slice(at, at + before.getInt32(4, true)), rows = batch.slice(at + ids.length, at + second);
  const end = readCodes(wordsOf(ids), 8 * 22, 8 * ids.length, ids[16], new Float64Array(rows.length / 33));
  const head = ids.slice(0, Math.ceil(end / 8)).fill(0, 0, 16);
  if (end & 7) head[head.length - 1] &= (1 << (end & 7)) - 1;
  const used = head.length + rows.length, out = new Uint8Array(at + used + (-used & 7)), data = new DataView(out.buffer);
  out.set(batch.subarray(0, at));
  out.set([...head, ...rows], at);
  data.setUint32(4, sequence, true);
  data.setBigInt64(48, BigInt(out.length - at + 24), true);
  data.setBigInt64(136, BigInt(used), true);
  [head.length, used, used, used].forEach((end, k) => data.setInt32(172 + 4 * k, end, true));
  return out;
}

const MEMORY = 1400; // bytes, in HELLO of the second record

/** Play a record; call `each` with every batch. */
function play(record: Vector, each: (batch: Batch, step: Step) => void): Receiver {
  let receiver: Receiver | null = null;
  for (const step of record.steps.filter((step) => step.from === "server")) {
    const bytes = bytesOf(step);
    if (isBatch(step)) each((receiver as Receiver).receive(bytes), step);
    else if (receiver === null) receiver = new Receiver(bytes, undefined, record === evicting);
    else assert.ok(receiver.resume(bytes));
  }
  return receiver as Receiver;
}

for (const record of [vector, evicting]) test("a client of a record receives what it says", () => {
  const ids: number[] = [];
  play(record, (batch, step) => {
    assert.equal(batch.first, ids.length);
    ids.push(...batch.ids);
    assert.deepEqual([...batch.ids], step.gaussians);
    assert.deepEqual([...batch.gone].map((slot) => ids[slot]).sort((a, b) => a - b), step.dropped);
    assert.equal(batch.terms.length, 2 * (step.terms as number[]).length);
    assert.ok([...batch.owners].every((slot) => slot < ids.length));
  });
});

for (const record of [vector, evicting]) test("a client of a record draws what it says", () => {
  const tables = tablesOf(new Receiver(bytesOf(record.steps[1])).about.colors);
  const splats: { id: number; splat: Splat; terms: Term[] }[] = [], chunks: number[] = [], dropped = new Set<number>();
  const { about } = play(record, (batch) => {
    chunks.push(...batch.chunks);
    const table = Float32Array.from(chunks);
    batch.ids.forEach(
      (id, i) => splats.push({ id, splat: decodeRecord(batch.records, i, table, batch.rows[i], tables), terms: [] }),
    );
    batch.owners.forEach((slot, i) => splats[slot].terms.push(decodeTerm(batch.terms, i, tables)));
    batch.gone.forEach((slot) => dropped.add(slot));
    assert.deepEqual([...batch.means], splats.slice(batch.first).flatMap(({ splat }) => splat.mean));
  });
  const drawn = splats.filter((_, slot) => !dropped.has(slot)).sort((a, b) => a.id - b.id);
  assert.deepEqual(drawn.map(({ id }) => id), record.drawn["ids"]);
  const found: Record<string, number[]> = {
    means: drawn.flatMap(({ splat }) => splat.mean),
    quats: drawn.flatMap(({ splat }) => splat.quat),
    scales: drawn.flatMap(({ splat }) => splat.scale),
    opacities: drawn.map(({ splat }) => splat.opacity),
    rgb: drawn.flatMap(({ splat, terms }) => colorSeen(splat, terms, record.eye, about.colors.variant)),
  };
  for (const [name, values] of Object.entries(found)) {
    const expected = (record.drawn[name] as number[][]).flat();
    assert.equal(values.length, expected.length);
    values.forEach(
      (value, k) => assert.ok(Math.abs(value - expected[k]) < 1e-6, `${name} ${k}: ${value}, not ${expected[k]}`),
    );
  }
});

test("a client with little memory says what it holds, and refuses to forget what it does not hold", () => {
  const [first, again] = evicting.steps.filter((step) => step.bytes.startsWith("0103"));
  const view = { left: 1, right: 1, up: 0.75, down: 0.75 }, reach = { margin: 0.125, near: 0.0625, memory: MEMORY };
  assert.equal(hex(hello(view, reach)), first.bytes);
  const receiver = new Receiver(bytesOf(evicting.steps[1]), undefined, true);
  const before = evicting.steps.slice(0, evicting.steps.indexOf(again)).filter(isBatch).map(bytesOf);
  for (const batch of before) receiver.receive(batch);
  assert.equal(hex(hello(view, reach, receiver.about.identity, receiver.holdings())), again.bytes);

  const evicts = evicting.steps.find((step) => step.evicted?.length) as Step;
  for (const [memory, words] of [[true, /evict what is held/], [false, /none evicted/]] as const) {
    const fresh = new Receiver(bytesOf(evicting.steps[1]), undefined, memory), batch = bytesOf(evicts);
    assert.throws(() => fresh.receive(changed(batch, 4, 1)), words);
  }
});

test("the row of a chunk that comes again is ignored", () => {
  const batches = evicting.steps.filter(isBatch).map(bytesOf);
  const receiver = new Receiver(bytesOf(evicting.steps[1]));
  const rows = receiver.receive(batches[0]).chunks.length / 8;
  assert.ok(rows > 0);
  const again = receiver.receive(chunksAlone(batches[0], 2));
  assert.equal(again.chunks.length, 0);
  assert.equal(again.firstRow, rows);
});

test("a client says the bytes of the record", () => {
  const said = vector.steps.filter((step) => step.from === "client").map((step) => step.bytes);
  const view = { left: 1, right: 1, up: 0.75, down: 0.75 }, reach = { margin: 0.125, near: 0.0625, memory: 0 };
  const pose = (k: number) => poseAt(100 * k, { position: [1.5 * k - 1.5, -1, 0.25], rotation: [1, 0, 0.25 * k, 0] });
  const receiver = new Receiver(bytesOf(vector.steps[1]));
  for (const step of vector.steps.filter(isBatch).slice(0, 2)) receiver.receive(bytesOf(step));
  const again = hello(view, reach, receiver.about.identity, receiver.holdings());
  const found = [hello(view, reach), ack(0), pose(0), ack(1), pose(1), ack(2), again, pose(2), ack(1), bye()];
  assert.deepEqual(found.map(hex), said);
});
