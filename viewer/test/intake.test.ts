// Long batches in pieces: nothing is lost, nothing changes its order.
import assert from "node:assert/strict";
import { test } from "node:test";
import { Intake, splitBatch } from "../src/core/intake.ts";
import type { Batch } from "../src/core/types.ts";

function batchOf(count: number, first: number, labels: boolean, terms = 3): Batch {
  const count32 = (n: number, from = 0) => Uint32Array.from({ length: n }, (_, k) => from + k);
  return {
    first, ids: count32(count, 7), records: count32(4 * count), rows: count32(count, 3),
    means: Float32Array.from(count32(3 * count)), firstRow: 5, chunks: Float32Array.from(count32(16)),
    boxes: Float32Array.from(count32(12)), chunkLevels: Uint8Array.of(0, 1, 1, 2), firstTerm: 9, terms: count32(2 * terms),
    owners: count32(terms, first), gone: count32(2), labels: labels ? count32(count, 4) : null,
  };
}

/** Return what all batches hold together; they must follow each other. */
function whole(batches: Batch[]): Record<string, number[]> {
  const found: Record<string, number[]> = {};
  let next = batches[0].first, row = batches[0].firstRow;
  for (const batch of batches) {
    assert.equal(batch.first, next);
    assert.equal(batch.firstRow, row);
    next += batch.ids.length;
    row += batch.chunks.length / 8;
    for (const [name, values] of Object.entries(batch)) {
      if (typeof values !== "number" && values) (found[name] ??= []).push(...(values as Uint32Array));
    }
  }
  return found;
}

test("pieces of a batch are the batch, and share no memory that moves", () => {
  for (const labels of [false, true]) {
    for (const [count, most, pieces] of [[10, 10, 1], [11, 10, 2], [30, 10, 3], [0, 10, 1]]) {
      const made = splitBatch(batchOf(count, 100, labels), most).map((piece) => piece());
      assert.equal(made.length, pieces);
      assert.deepEqual(whole(made), whole([batchOf(count, 100, labels)]));
      const buffers = made.map((batch) => batch.records.buffer);
      assert.equal(new Set(buffers).size, pieces);
      assert.deepEqual(made.slice(0, -1).flatMap((batch) => [...batch.owners, ...batch.gone]), []);
    }
  }
});

test("many terms come in pieces of their own, behind their Gaussians", () => {
  for (const [count, pieces] of [[25, 6], [5, 4], [0, 3]]) {
    const given = batchOf(count, 100, false, 50), made = splitBatch(given, 10).map((piece) => piece());
    assert.equal(made.length, pieces);
    assert.deepEqual(whole(made), whole([given]));
    for (const batch of made) assert.ok(batch.ids.length === 0 || batch.owners.length === 0);
    const own = made.filter((batch) => batch.owners.length);
    assert.deepEqual(own.map((batch) => batch.firstTerm), [9, 29, 49]);
  }
});

test("batches are handed on in order, and what is forgotten is not", async () => {
  const taken: Batch[] = [], intake = new Intake((batch) => taken.push(batch));
  intake.add(batchOf(20_000, 0, false));
  intake.add(batchOf(5, 20_000, false));
  while (intake.isBusy) await new Promise((done) => { setTimeout(done, 1); });
  assert.deepEqual(taken.map((batch) => batch.ids.length), [8192, 8192, 3616, 5]);
  assert.deepEqual(taken.map((batch) => batch.first), [0, 8192, 16384, 20_000]);
  intake.add(batchOf(5, 20_005, false));
  intake.clear();
  assert.ok(!intake.isBusy);
});
