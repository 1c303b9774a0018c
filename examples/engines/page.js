// What all pages share: open the scene, choose levels when the eye moves or turns, and say what is there.
import { LeafQueue } from "./leaf-queue.js";
import { chooseLevels, loadOrder } from "./level-choice.js";
import { NeededLeaves } from "./needed-leaves.js";
import { Walk } from "./walk.js";

/** Runs a scene in a player that has `load(url)`, `show(thing, yes)` and `free(thing)`. Returns the walk, and a function to call every frame. */
export async function runScene(canvas, player) {
  const asked = new URLSearchParams(location.search), line = document.querySelector("p");
  const scene = await NeededLeaves.open(asked.get("scene") ?? "scene/").catch((error) => {
    line.textContent = error.message;
    throw error;
  });
  const walk = new Walk(canvas, scene.header), all = scene.leaves.length;
  if (scene.environment) player.load(scene.environment).then((thing) => player.show(thing, true));
  let plan = null, planned = null, before = null;
  const say = () => {
    const state = { cell: plan?.cell?.box ?? null, leaves: all, needed: plan?.load.length ?? 0,
      lods: plan ? [...plan.lods] : [], drawn: queue.shown,
      held: queue.gaussians, complete: plan !== null && queue.complete, failed: queue.failed };
    globalThis.streamed = state;
    line.textContent = queue.failed[0] ?? `${state.needed} of ${all} leaves needed here, ${state.drawn.toLocaleString("en")} Gaussians drawn`;
  };
  const budget = Number(asked.get("splats") ?? 1e6), options = { fill: asked.has("splats"), quality: Number(asked.get("quality") ?? Infinity) };
  const queue = new LeafQueue(scene.leaves, player, { most: Number(asked.get("most") ?? 2e6), changed: say });
  const frame = (seconds) => {
    const target = walk.step(seconds), now = [...walk.position, ...walk.forward];
    if (!planned || now.some((value, k) => Math.abs(value - planned[k]) > (k < 3 ? 0.1 * scene.header.size : 0.1))) {
      planned = now;
      const views = [{ position: walk.position, forward: walk.forward }];
      if (before) views.push({ position: walk.position.map((p, k) => 2 * p - before[k]), forward: walk.forward, weight: 0.25 }); // a look ahead
      before = walk.position;
      const { lods } = chooseLevels(scene, views, budget, options);
      plan = { ...scene.plan(walk.position, walk.forward), lods, order: loadOrder(scene, views, lods) };
      queue.follow(plan);
    }
    return target;
  };
  document.title = `${scene.header.name} · ${document.title}`;
  return { walk, frame };
}
