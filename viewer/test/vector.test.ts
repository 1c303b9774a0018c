// The recorded exchange of tests/stream/vector.json: the client of the record, from its bytes alone.
import assert from "node:assert/strict";
import { test } from "node:test";
import { Receiver } from "../src/core/receiver.ts";
import { colorSeen, decodeRecord, decodeTerm, tablesOf } from "../src/core/tables.ts";
import type { Splat, Term } from "../src/core/tables.ts";
import type { Batch } from "../src/core/types.ts";
import { bytesOf, hex, isBatch, vector } from "./fakes.ts";
import type { Step } from "./fakes.ts";
import { ack, bye, hello, poseAt } from "../src/core/wire.ts";

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
  const tables = tablesOf(new Receiver(bytesOf(vector.steps[1])).about.colors);
  const splats: { id: number; splat: Splat; terms: Term[] }[] = [], chunks: number[] = [], dropped = new Set<number>();
  const { about } = play((batch) => {
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
  assert.deepEqual(drawn.map(({ id }) => id), vector.drawn["ids"]);
  const found: Record<string, number[]> = {
    means: drawn.flatMap(({ splat }) => splat.mean),
    quats: drawn.flatMap(({ splat }) => splat.quat),
    scales: drawn.flatMap(({ splat }) => splat.scale),
    opacities: drawn.map(({ splat }) => splat.opacity),
    rgb: drawn.flatMap(({ splat, terms }) => colorSeen(splat, terms, vector.eye, about.colors.variant)),
  };
  for (const [name, values] of Object.entries(found)) {
    const expected = (vector.drawn[name] as number[][]).flat();
    assert.equal(values.length, expected.length);
    values.forEach(
      (value, k) => assert.ok(Math.abs(value - expected[k]) < 1e-6, `${name} ${k}: ${value}, not ${expected[k]}`),
    );
  }
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
