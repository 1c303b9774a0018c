// Where visitors get who walk at random by the page's own keys, without a browser.
// node random-walks.mjs GRID WALKS SECONDS OUT: GRID is an unpacked grid (src/page/walk.ts). Writes for each frame of
// each walk the eye as three float64, and prints the number of frames of a walk.
import { readFileSync, writeFileSync } from "node:fs";
import { Navigator, NOTHING_HELD } from "../src/page/navigator.ts";
import type { Held } from "../src/page/navigator.ts";
import { NORMAL_FOV, rigFromTarget } from "../src/page/rig.ts";
import { add, frameFromUp, scale } from "../src/page/vector.ts";
import { readWalk, WalkGround } from "../src/page/walk.ts";

const FRAMES = 60; // a second
const [path, walks, seconds, out] = process.argv.slice(2);
const grid = readWalk(new Uint8Array(readFileSync(path)))!, frame = frameFromUp(grid.axes[2]);
const frames = Number(seconds) * FRAMES, eyes = new Float64Array(Number(walks) * frames * 3);

let state = 1;
function random(): number {
  state = (Math.imul(state, 1664525) + 1013904223) >>> 0;
  return state / 2 ** 32;
}

/** Return keys that a visitor may hold for a while: mostly ahead, often turning, at times running. */
function keys(): Held {
  const side = (share: number): number => (random() < share ? (random() < 0.5 ? -1 : 1) : 0);
  const ahead = random() < 0.7 ? 1 : side(0.5);
  return { ...NOTHING_HELD, ahead, aside: side(0.3), turn: side(0.5), tilt: side(0.1), fast: random() < 0.3 };
}

for (let walk = 0; walk < Number(walks); walk++) {
  const ground = new WalkGround(grid);
  const corner = grid.shape.map((n, k) => scale(grid.axes[k], n * grid.size * random())).reduce(add, grid.origin);
  const eye = ground.nearest(corner), turn = 2 * Math.PI * random();
  const ahead = add(scale(frame.north, Math.cos(turn)), scale(frame.east, Math.sin(turn)));
  const navigator = new Navigator(frame, rigFromTarget(eye, add(eye, scale(ahead, grid.eye)), frame, NORMAL_FOV));
  [navigator.calm, navigator.mode] = [true, "walk"];
  navigator.standOn(ground);
  let [held, left] = [NOTHING_HELD, 0];
  for (let k = 0; k < frames; k++) {
    if ((left -= 1) < 0) [held, left] = [keys(), FRAMES * (0.1 + 2 * random())];
    navigator.step(random() < 0.02 ? 0.2 : 1 / FRAMES, held);
    eyes.set(navigator.shown.eye, 3 * (walk * frames + k));
  }
}
writeFileSync(out, eyes);
console.log(frames);
