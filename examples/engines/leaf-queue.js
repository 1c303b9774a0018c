// Loads and shows leaves at the chosen levels, for any player. No dependencies.

/** player: `load(url)` resolves to a thing that is not drawn yet; `show(thing, yes)`; `free(thing)`. */
export class LeafQueue {
  /** parallel: files at once. most: Gaussians to hold; beyond it, leaves that are not chosen are freed. */
  constructor(leaves, player, { parallel = 4, most = Infinity, changed = () => {} } = {}) {
    Object.assign(this, { leaves, player, parallel, most, changed });
    this.running = 0;
    this.failed = [];
    this.steps = [];
    this.lods = leaves.map(() => -1);
    this.held = leaves.map(() => new Map()); // level of detail -> thing; null while it loads
  }

  /** Follows a choice: `lods` (the level of each leaf, -1: not drawn) and `order` ([leaf, level] to load); then the coarsest level of each of `keep`. */
  follow({ lods, order, keep = [] }) {
    this.lods = lods;
    const may = new Set(keep);
    this.steps = [...order, ...keep.map((leaf) => [leaf, this.levels(leaf).at(-1)])];
    for (let leaf = 0; leaf < lods.length; leaf++) {
      if (lods[leaf] < 0 && !may.has(leaf) && this.gaussians > this.most) this.release(leaf);
      this.showBest(leaf);
    }
    this.next();
  }

  /** Gaussians in memory, and those of them that are drawn. */
  get gaussians() { return this.count(() => true); }
  get shown() { return this.count((leaf, lod) => lod === this.best(leaf)); }
  get complete() { return this.running === 0 && this.steps.length === 0; }

  count(of) {
    let sum = 0;
    this.held.forEach((things, leaf) => things.forEach((thing, lod) => {
      if (thing && of(leaf, lod)) sum += this.leaves[leaf].lods[lod].count;
    }));
    return sum;
  }

  levels(leaf) { return this.leaves[leaf].lods.flatMap((run, lod) => (run ? [lod] : [])); }

  /** The level of a leaf to draw: the chosen one, else a coarser one that is there, else a finer one; none for -1. */
  best(leaf) {
    const there = this.levels(leaf).filter((lod) => this.held[leaf].get(lod)), chosen = this.lods[leaf];
    return chosen < 0 ? undefined : there.find((lod) => lod >= chosen) ?? there.at(-1);
  }

  next() {
    while (this.running < this.parallel && this.steps.length) {
      const [leaf, lod] = this.steps.shift(), things = this.held[leaf], chosen = this.lods[leaf];
      if (things.has(lod) || things.has(chosen)) continue; // it is there, or on its way
      things.set(lod, null);
      this.running++;
      this.player.load(this.leaves[leaf].lods[lod].url).then(
        (thing) => { things.set(lod, thing); this.showBest(leaf); },
        (error) => { things.delete(lod); this.failed.push(String(error?.message ?? error)); },
      ).finally(() => { this.running--; this.next(); });
    }
    this.changed();
  }

  /** Shows the best level of a leaf, and frees the others once the chosen one is there. */
  showBest(leaf) {
    const best = this.best(leaf), things = this.held[leaf];
    for (const [lod, thing] of [...things]) {
      if (!thing) continue;
      this.player.show(thing, lod === best);
      if (best !== undefined && best === this.lods[leaf] && lod !== best) { this.player.free(thing); things.delete(lod); }
    }
  }

  release(leaf) {
    for (const [lod, thing] of [...this.held[leaf]]) {
      if (thing) { this.player.free(thing); this.held[leaf].delete(lod); }
    }
  }
}
