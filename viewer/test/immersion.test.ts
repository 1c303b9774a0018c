// When the page offers an immersive session.

import assert from "node:assert/strict";
import { test } from "node:test";

import { Immersion, type XrSystem } from "../src/page/xr.ts";

/** A browser whose headset comes and goes. */
class Headset extends EventTarget implements XrSystem {
  there: boolean | Error = false;

  async isSessionSupported(): Promise<boolean> {
    if (this.there instanceof Error) throw this.there;
    return this.there;
  }

  requestSession(): never {
    throw new Error("not asked for here");
  }

  async becomes(there: boolean | Error): Promise<void> {
    this.there = there;
    this.dispatchEvent(new Event("devicechange"));
    await settled();
  }
}

const settled = (): Promise<void> => new Promise((done) => setTimeout(done));

test("a headset that comes after the page is offered, and one that goes is not", async () => {
  const headset = new Headset();
  const offers: boolean[] = [];
  const immersion: Immersion = new Immersion(() => offers.push(immersion.offered), headset);
  await settled();
  assert.deepEqual([immersion.offered, offers], [false, []]);
  await headset.becomes(true);
  await headset.becomes(true);
  await headset.becomes(false);
  assert.deepEqual(offers, [true, false]);
});

test("a browser that refuses to say, or knows no headsets, offers none", async () => {
  const headset = new Headset();
  headset.there = new Error("the policy of the page forbids it");
  const offers: boolean[] = [];
  const refused: Immersion = new Immersion(() => offers.push(refused.offered), headset);
  const without = new Immersion(() => offers.push(true), null);
  await settled();
  assert.deepEqual([refused.offered, without.offered, offers], [false, false, []]);
  await headset.becomes(true);
  assert.deepEqual(offers, [true]);
});
