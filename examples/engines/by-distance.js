// Levels by distance alone, as PlayCanvas' engine 2.23 chooses them within a budget. No dependencies.

const FINER = 3; // a level is used up to so many times the distance of the one before

/** Returns the distance of a leaf from an eye: to its box, shrunk by three quarters of what it has beyond the median box; half as far again straight behind. */
function distanceOf({ min, max }, median, position, forward) {
  const away = position.map((p, k) => {
    const shrunk = 0.75 * Math.max((max[k] - min[k]) / 2 - median[k], 0);
    return Math.min(Math.max(p, min[k] + shrunk), max[k] - shrunk) - p;
  });
  const distance = Math.hypot(...away);
  if (!forward || distance <= 1e-2) return Math.max(distance, 1e-6);
  const behind = Math.max(-away.reduce((sum, a, k) => sum + a * forward[k], 0) / (distance * Math.hypot(...forward)), 0);
  return distance * (1 + behind / 2);
}

/** Returns the level of each leaf by distance alone, as PlayCanvas' engine chooses it: the coarsest of each, then finer ones
 * in the order of distance, each level a third as far as the one before, until the next does not fit. All -1 if the coarsest do not fit. */
export function levelsByDistance(scene, views, most = Infinity) {
  const { leaves } = scene, levels = leaves.map(({ lods }) => [...lods.keys()].filter((lod) => lods[lod]));
  const count = (leaf, lod) => leaves[leaf].lods[lod].count, steps = [];
  const cameras = views.filter(({ weight = 1 }) => weight >= 1);
  const median = [0, 1, 2].map((k) => leaves.map(({ min, max }) => (max[k] - min[k]) / 2).sort((a, b) => a - b)[leaves.length >> 1]);
  const lods = Int8Array.from(levels, (own) => own.at(-1) ?? -1);
  let left = most - lods.reduce((sum, lod, leaf) => sum + (lod < 0 ? 0 : count(leaf, lod)), 0);
  if (left < 0 || !cameras.length) return lods.fill(-1);
  levels.forEach((own, leaf) => {
    const distance = Math.min(...cameras.map(({ position, forward }) => distanceOf(leaves[leaf], median, position, forward)));
    own.slice(0, -1).forEach((lod, k) => steps.push({ leaf, lod, paid: count(leaf, lod) - count(leaf, own[k + 1]), key: distance / FINER ** (lod + 1) }));
  });
  for (const { leaf, lod, paid } of steps.sort((a, b) => a.key - b.key || b.lod - a.lod || a.leaf - b.leaf)) {
    if (paid > left) break;
    left -= paid;
    lods[leaf] = lod;
  }
  return lods;
}
