// Which level of each leaf to draw within a budget, and in which order to load: most error removed per splat, or per
// byte, first. The error of a leaf is its light in a cell times the error of a level.
//
//   const scene = await NeededLeaves.open("scene/");
//   const views = [{ position: [x, y, z], forward: [dx, dy, dz] }];
//   const { lods, splats } = chooseLevels(scene, views, 1e6);  // -1: do not draw this leaf
//   for (const [leaf, lod] of loadOrder(scene, views, lods)) ...
import { levelsByDistance } from "./by-distance.js";
import { power } from "./needed-leaves.js";

const BEHIND = 1 / 16; // worth of a leaf that is not in the view
const BESIDE = 1 / 64, ELSEWHERE = 1 / 4096; // worth of light in neighboring cells, and in any cell, where a budget is to be filled

/** Returns the rows of a view: of its cell; with `fill`, of the neighboring cells, too, each with its share of the worth. */
function rowsOf(scene, position, fill) {
  const cell = scene.cellAt(position), near = fill && cell ? scene.neighbors(cell) : [];
  return [[cell?.row ?? 0, 1], ...near.map(({ row }) => [row, BESIDE])];
}

/** Returns the worth of each leaf: its light, the largest of all views.
 *
 * A view has a `position` and, optionally, a `forward` direction and a `weight` (1): several cameras are several views,
 * a look ahead is a view from where the camera will be, with a smaller weight. `fill`: what the cell does not see has a little worth, too. */
export function leafLights(scene, views, fill = false) {
  const lights = new Float64Array(scene.leaves.length);
  for (const { position, forward = null, weight = 1 } of views) {
    const parts = [...rowsOf(scene, position, fill), ...(fill ? [[0, ELSEWHERE]] : [])];
    const near = scene.leaves.map((_, leaf) => (!forward || scene.ahead(leaf, position, forward) ? 1 : BEHIND));
    for (const [row, share] of parts) {
      scene.rows[row].forEach((byte, leaf) => { if (byte) lights[leaf] = Math.max(lights[leaf], weight * share * near[leaf] * power(byte - 255)); });
    }
  }
  return lights;
}

/** Returns what guards a budget: the level of each leaf by distance, whether a camera looks at it, and whether its cell (or a neighboring one, for `fill`) sees it then. */
function guardOf(scene, views, most, fill) {
  const cameras = views.filter(({ weight = 1 }) => weight >= 1), looks = (leaf) => ({ position, forward = null }) => !forward || scene.ahead(leaf, position, forward) > 0;
  const ahead = scene.leaves.map((_, leaf) => cameras.filter(looks(leaf)));
  const seen = ahead.map((some, leaf) => some.some(({ position }) => rowsOf(scene, position, fill).some(([row]) => scene.rows[row][leaf])));
  return { distance: levelsByDistance(scene, views, most), ahead: ahead.map((some) => some.length > 0), seen };
}

/** Returns the finest level that a leaf may have in each phase of a choice. */
function phasesOf(scene, { distance, ahead, seen }) {
  const coarsest = scene.leaves.map(({ lods }) => lods.findLastIndex((lod) => lod));
  return [
    (leaf) => (seen[leaf] ? 0 : coarsest[leaf]), // what the cameras see; of the rest, something to turn to
    (leaf) => (seen[leaf] ? 0 : ahead[leaf] && distance[leaf] >= 0 ? distance[leaf] : coarsest[leaf]), // the visible set may miss something
    () => 0,
  ];
}

/** Returns the error of a leaf at a level, -1 for not drawn. */
const errorOf = ({ leaves, header }, leaf, lod) => (lod < 0 ? header.absent : leaves[leaf].errors[lod]);

/** Returns the next step of a leaf from a level (-1: not drawn) that costs at most `left`: the one that removes most error for its cost. */
function nextStep(scene, leaf, light, from, left, { cost, last }) {
  const { lods, errors } = scene.leaves[leaf], error = errorOf(scene, leaf, from);
  let best = null;
  for (let lod = (from < 0 ? lods.length : from) - 1; lod >= last(leaf); lod--) {
    if (!lods[lod] || errors[lod] >= error) continue;
    const paid = cost(lods[lod], from < 0 ? null : lods[from]), gain = (light * (error - errors[lod])) / Math.max(paid, 1);
    if (paid <= left && (!best || gain > best.gain)) best = { leaf, from, lod, paid, gain };
  }
  return best;
}

/** Yields the steps of all leaves from the level where each begins, best first, as long as one fits into the budget. */
function* takeSteps(scene, lights, budget, rules) {
  let left = budget;
  const next = (leaf, from) => nextStep(scene, leaf, lights[leaf], from, left, rules);
  const before = (a, b) => b.gain - a.gain || a.leaf - b.leaf;
  const waiting = [...lights.keys()].flatMap((leaf) => (lights[leaf] > 0 ? next(leaf, rules.first(leaf)) ?? [] : [])).sort(before);
  const insert = (step) => {
    let low = 0, high = waiting.length;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (before(waiting[middle], step) < 0) low = middle + 1;
      else high = middle;
    }
    waiting.splice(low, 0, step);
  };
  while (waiting.length) {
    const step = waiting.shift(), fits = step.paid <= left;
    if (fits) {
      left -= step.paid;
      yield step;
    }
    const more = next(step.leaf, fits ? step.lod : step.from); // a cheaper one, if that did not fit
    if (more) insert(more);
  }
}

/** Returns the level of each leaf (-1: do not draw it) so that at most so many splats are drawn, and their number.
 *
 * It begins with the choice by distance for what the cameras see, and spends on light times error what that choice spends on the rest. So
 * no leaf in view is coarser than by distance. The rest gets more than its coarsest level when no step for what is seen fits. `guard: false` begins with nothing.
 * `quality` ends the choice when so many dB of PSNR are expected, against everything at its finest level.
 * `fill` spends what is left of the budget in each phase on leaves that the cell does not see: they show where its visible set misses something.
 * What neighboring cells see is then no coarser than by distance, either. With a wanted PSNR, and without a budget, it does nothing. */
export function chooseLevels(scene, views, most = Infinity, { fill = true, guard = true, quality = Infinity } = {}) {
  const fills = fill && most < Infinity && quality === Infinity;
  const guarded = guard && most < Infinity ? guardOf(scene, views, most, fills) : null;
  const lods = Int8Array.from(scene.leaves, (_, leaf) => (guarded?.seen[leaf] ? guarded.distance[leaf] : -1));
  const sum = (of) => lods.reduce((total, lod, leaf) => total + of(leaf, lod), 0), lights = leafLights(scene, views);
  let splats = sum((leaf, lod) => (lod < 0 ? 0 : scene.leaves[leaf].lods[lod].count));
  let error = sum((leaf, lod) => lights[leaf] * errorOf(scene, leaf, lod));
  const enough = quality < Infinity ? 10 ** (-quality / 10) * sum((leaf) => lights[leaf]) : -Infinity;
  const turns = fills ? [lights, leafLights(scene, views, true)] : [lights];
  for (const last of guarded ? phasesOf(scene, guarded) : [() => 0]) {
    for (const some of turns) {
      const rules = { cost: (to, from) => to.count - (from?.count ?? 0), first: (leaf) => lods[leaf], last };
      for (const { leaf, from, lod, paid } of takeSteps(scene, some, most - splats, rules)) {
        if (error <= enough) break;
        error -= lights[leaf] * (errorOf(scene, leaf, from) - errorOf(scene, leaf, lod));
        lods[leaf] = lod;
        splats += paid;
      }
    }
  }
  return { lods, splats };
}

/** Returns [leaf, level] in the order to load, up to the chosen levels: most error removed per byte first, until so many bytes; what the cell does not see last. */
export function loadOrder(scene, views, lods, most = Infinity) {
  const there = new Map(), bytes = (leaf, lod) => scene.leaves[leaf].lods[lod].bytes;
  const rules = { cost: (to) => to.bytes, first: (leaf) => there.get(leaf) ?? -1, last: (leaf) => (lods[leaf] < 0 ? Infinity : lods[leaf]) };
  const order = [];
  let left = most;
  const load = (leaf, lod) => {
    there.set(leaf, lod);
    order.push([leaf, lod]);
    left -= bytes(leaf, lod);
  };
  for (const fill of [false, true]) {
    for (const { leaf, lod } of takeSteps(scene, leafLights(scene, views, fill), left, rules)) load(leaf, lod);
  }
  lods.forEach((lod, leaf) => { // a chosen level that has no less error than a coarser one comes last
    if (lod >= 0 && there.get(leaf) !== lod && bytes(leaf, lod) <= left) load(leaf, lod);
  });
  return order;
}
