// Which level of each leaf to draw within a budget, and in which order to load: most error removed per splat, or per
// byte, first. The error of a leaf is its light in a cell times the error of a level. No dependencies.
//
//   const scene = await NeededLeaves.open("scene/");
//   const views = [{ position: [x, y, z], forward: [dx, dy, dz] }];
//   const { lods, splats } = chooseLevels(scene, views, 1e6);  // -1: do not draw this leaf
//   for (const [leaf, lod] of loadOrder(scene, views, lods)) ...
import { power } from "./needed-leaves.js";

const BEHIND = 1 / 16; // worth of a leaf that is not in the view
const BESIDE = 1 / 64, ELSEWHERE = 1 / 4096; // worth of light in neighboring cells, and in any cell, where a budget is to be filled

/** Returns the worth of each leaf: its light, the largest of all views.
 *
 * A view has a `position` and, optionally, a `forward` direction and a `weight` (1): several cameras are several views,
 * a look ahead is a view from where the camera will be, with a smaller weight. `fill`: what the cell does not see has a little worth, too. */
export function leafLights(scene, views, fill = false) {
  const lights = new Float64Array(scene.leaves.length);
  for (const { position, forward = null, weight = 1 } of views) {
    const cell = scene.cellAt(position), parts = [[cell?.row ?? 0, weight]];
    if (fill) parts.push(...(cell ? scene.neighbors(cell) : []).map(({ row }) => [row, weight * BESIDE]), [0, weight * ELSEWHERE]);
    const near = scene.leaves.map((_, leaf) => (!forward || scene.ahead(leaf, position, forward) ? 1 : BEHIND));
    for (const [row, share] of parts) {
      scene.rows[row].forEach((byte, leaf) => { if (byte) lights[leaf] = Math.max(lights[leaf], share * near[leaf] * power(byte - 255)); });
    }
  }
  return lights;
}

/** Returns the next step of a leaf from a level (-1: not drawn) that costs at most `left`: the one that removes most error for its cost. */
function nextStep({ leaves, header }, leaf, light, from, left, { cost, last }) {
  const { lods, errors } = leaves[leaf], error = from < 0 ? header.absent : errors[from];
  let best = null;
  for (let lod = (from < 0 ? lods.length : from) - 1; lod >= last(leaf); lod--) {
    if (!lods[lod] || errors[lod] >= error) continue;
    const paid = cost(lods[lod], from < 0 ? null : lods[from]), gain = (light * (error - errors[lod])) / Math.max(paid, 1);
    if (paid <= left && (!best || gain > best.gain)) best = { leaf, from, lod, paid, gain };
  }
  return best;
}

/** Yields the steps of all leaves, best first, as long as one fits into the budget. */
function* takeSteps(scene, lights, budget, rules) {
  let left = budget;
  const next = (leaf, from) => nextStep(scene, leaf, lights[leaf], from, left, rules);
  const before = (a, b) => b.gain - a.gain || a.leaf - b.leaf;
  const waiting = [...lights.keys()].flatMap((leaf) => (lights[leaf] > 0 ? next(leaf, -1) ?? [] : [])).sort(before);
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
 * `fill` spends what is left of the budget on leaves that the cell does not see: they show where its visible set misses something. */
export function chooseLevels(scene, views, most = Infinity, { fill = false } = {}) {
  const lods = new Int8Array(scene.leaves.length).fill(-1);
  const rules = { cost: (to, from) => to.count - (from?.count ?? 0), last: () => 0 };
  let splats = 0;
  for (const { leaf, lod, paid } of takeSteps(scene, leafLights(scene, views, fill), most, rules)) {
    lods[leaf] = lod;
    splats += paid;
  }
  return { lods, splats };
}

/** Returns [leaf, level] in the order to load, up to the chosen levels: most error removed per byte first, until so many bytes. */
export function loadOrder(scene, views, lods, most = Infinity, { fill = false } = {}) {
  const rules = { cost: (to) => to.bytes, last: (leaf) => (lods[leaf] < 0 ? Infinity : lods[leaf]) };
  return [...takeSteps(scene, leafLights(scene, views, fill), most, rules)].map(({ leaf, lod }) => [leaf, lod]);
}
