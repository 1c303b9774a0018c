// Messages of a server that lies: refused as a whole, before memory is spent on them.
import assert from "node:assert/strict";
import { test } from "node:test";
import { readCodes, wordsOf } from "../src/core/bits.ts";
import { headerOf, parseWelcome } from "../src/core/header.ts";
import { Receiver } from "../src/core/receiver.ts";
import { ProtocolError } from "../src/core/wire.ts";
import { batches, changed, hex, reworded, welcome } from "./fakes.ts";

/** A generator of numbers below 2^32 (a linear congruence), the same in every run. */
function numbers(seed: number): () => number {
  let state = seed;
  return () => {
    state = (Math.imul(state, 1664525) + 1013904223) >>> 0;
    return state;
  };
}

const stateOf = (receiver: Receiver) => [
  hex(receiver.holdings()), receiver.next, receiver.gaussians, receiver.terms, receiver.replaced,
].join();

test("a batch with any byte changed is refused as a whole, or is another valid one", () => {
  const next = numbers(1);
  let refused = 0;
  for (const [k, batch] of batches.slice(0, 2).entries()) {
    for (let at = 0; at < batch.length; at++) {
      const receiver = new Receiver(welcome);
      for (const before of batches.slice(0, k)) receiver.receive(before);
      const before = stateOf(receiver);
      try {
        const found = receiver.receive(changed(batch, at, batch[at] ^ (1 + (next() >>> 8) % 255)));
        assert.ok(found.owners.every((slot) => slot < receiver.gaussians));
        assert.ok(found.means.every(Number.isFinite));
        assert.ok(found.rows.every((row) => row < found.firstRow + found.chunks.length / 8));
      } catch (error) {
        assert.ok(error instanceof ProtocolError, String(error));
        assert.equal(stateOf(receiver), before);
        refused++;
      }
    }
  }
  assert.ok(refused > 300);
});

test("a batch of any other length is refused", () => {
  for (let length = 0; length < batches[0].length; length++) {
    assert.throws(() => new Receiver(welcome).receive(batches[0].slice(0, length)), ProtocolError);
  }
  const longer = new Uint8Array(batches[0].length + 8);
  longer.set(batches[0]);
  assert.throws(() => new Receiver(welcome).receive(longer), ProtocolError);
});

test("a WELCOME with any byte changed is refused, or is another header", () => {
  const next = numbers(2);
  for (let at = 0; at < welcome.length; at++) {
    try {
      const header = parseWelcome(changed(welcome, at, next() & 255));
      assert.match(header.identity, /^[0-9a-f]{64}$/);
      assert.ok(header.terms <= 255 * header.gaussians && header.termBits <= 64);
    } catch (error) {
      assert.ok(error instanceof ProtocolError, String(error));
    }
  }
  for (let length = 0; length < welcome.length; length += 7) {
    assert.throws(
      () => parseWelcome(welcome.slice(0, length)), ProtocolError,
    );
  }
  assert.throws(() => parseWelcome(new Uint8Array(2 ** 20 + 1).fill(129)), ProtocolError);
});

test("a header that contradicts itself is refused", () => {
  const colors = parseWelcome(welcome).colors;
  const good = {
    gaussians: 10, terms: 20, chunks: 1, levels: [{ name: "a", count: 10 }], record_bytes: 16, term_bits: 25, colors,
    up: [0, -2, 0], meters_per_unit: 0.5, identity: "0".repeat(64),
  };
  assert.deepEqual(headerOf(good, "here").up, [0, -1, 0]);
  for (const bad of [
    { gaussians: 2 ** 29 }, { gaussians: 1.5 }, { gaussians: -1 }, { gaussians: "10" }, { terms: 2551 }, { chunks: 11 },
    { levels: [] },
    { levels: Array(17).fill(good.levels[0]) }, { levels: [{ name: 1, count: 1 }] },
    { levels: [{ name: "a", count: 11 }] }, { record_bytes: 15 },
    { term_bits: 24 }, { up: [0, 0, 0] }, { up: [0, 1] }, { meters_per_unit: -1 }, { meters_per_unit: null },
    { identity: "0".repeat(63) },
    { identity: "G".repeat(64) }, { colors: null }, { colors: { ...colors, variant: "yuv" } },
    { colors: { ...colors, base: [[0, 1]] } },
    { colors: { ...colors, base: [[1, 0], [0, 1], [0, 1]] } }, { colors: { ...colors, scales: [0, 1] } },
    { colors: { ...colors, decays: [1, 1e5] } },
    { colors: { ...colors, intensity: -1 } }, { colors: { ...colors, precision: { ...colors.precision, base: 9 } } },
    { colors: { ...colors, precision: { ...colors.precision, center: 1 } } },
  ]) assert.throws(() => headerOf({ ...good, ...bad }, "here"), ProtocolError, JSON.stringify(bad));
  for (const bad of [null, 1, "x", []]) assert.throws(() => headerOf(bad, "here"), ProtocolError);
});

test("a scene larger than allowed is refused before anything is reserved", () => {
  assert.throws(
    () => new Receiver(reworded('"gaussians":300,', '"gaussians":2e8,')),
    /WELCOME: this scene needs 1001 MB .* more than 537/,
  );
  assert.throws(() => new Receiver(welcome, 1000), /needs 1 MB/);
  assert.ok(new Receiver(welcome, 5 * 300 + 199));
});

test("codes are read as the page says, and strings that are none are refused", () => {
  const read = (bits: string, order: number, count: number) => {
    const bytes = new Uint8Array(Math.ceil(bits.length / 8));
    [...bits].forEach((bit, k) => { bytes[k >>> 3] |= Number(bit) << (k & 7); });
    const values = new Float64Array(count);
    return readCodes(wordsOf(bytes), 0, 8 * bytes.length, order, values) < 0 ? null : [...values];
  };
  assert.deepEqual(read("1" + "010" + "011", 0, 3), [0, 1, 2]);
  assert.deepEqual(read("1" + "00000", 5, 1), [0]);
  assert.deepEqual(read("0".repeat(32) + "1" + "0".repeat(32), 0, 1), [2 ** 32 - 1]);
  assert.deepEqual(read("0".repeat(32) + "1" + "1".repeat(33), 1, 1), [2 ** 34 - 1 - 2]);
  assert.equal(read("0".repeat(33) + "1" + "0".repeat(40), 0, 1), null);
  assert.equal(read("0".repeat(32) + "1" + "0".repeat(40), 2, 1), null);
  assert.equal(read("0".repeat(64), 0, 1), null);
  assert.equal(read("0001000", 0, 2), null);
});
