// Loads and shows leaves as the plans of NeededLeaves say, for any player. No dependencies.

/** player: `load(url)` resolves to a thing that is not drawn yet; `show(thing, yes)`; `free(thing)`. */
export class LeafQueue {
  /** parallel: files at once. most: Gaussians to hold; beyond it, leaves that a plan hides are freed. */
  constructor(leaves, player, { parallel = 4, most = Infinity, changed = () => {} } = {}) {
    Object.assign(this, { leaves, player, parallel, most, changed });
    this.running = 0;
    this.failed = [];
    this.steps = [];
    this.drawn = new Set();
    this.held = leaves.map(() => new Map()); // level of detail -> thing; null while it loads
  }

  /** Follows a plan: first the coarsest level of what is needed, then the finest, then the coarsest of what may be needed next. */
  follow({ load, keep, hide }) {
    this.drawn = new Set(load);
    this.steps = [];
    for (const leaf of load) this.steps.push([leaf, this.levels(leaf).at(-1)]);
    for (const leaf of load) this.steps.push([leaf, this.levels(leaf)[0]]);
    for (const leaf of keep) this.steps.push([leaf, this.levels(leaf).at(-1)]);
    for (const leaf of hide) if (this.gaussians > this.most) this.release(leaf);
    for (let leaf = 0; leaf < this.held.length; leaf++) this.showBest(leaf);
    this.next();
  }

  /** Gaussians in memory, and those of them that are drawn. */
  get gaussians() { return this.count(() => true); }
  get shown() { return this.count((leaf, lod) => this.drawn.has(leaf) && lod === this.best(leaf)); }
  get complete() { return this.running === 0 && this.steps.length === 0; }

  count(of) {
    let sum = 0;
    this.held.forEach((things, leaf) => things.forEach((thing, lod) => {
      if (thing && of(leaf, lod)) sum += this.leaves[leaf].lods[lod].count;
    }));
    return sum;
  }

  levels(leaf) { return this.leaves[leaf].lods.flatMap((run, lod) => (run ? [lod] : [])); }
  best(leaf) { return this.levels(leaf).find((lod) => this.held[leaf].get(lod)); }

  next() {
    while (this.running < this.parallel && this.steps.length) {
      const [leaf, lod] = this.steps.shift(), things = this.held[leaf];
      if (this.levels(leaf).some((other) => other <= lod && things.has(other))) continue; // that level, or a finer one
      things.set(lod, null);
      this.running++;
      this.player.load(this.leaves[leaf].lods[lod].url).then(
        (thing) => { things.set(lod, thing); this.showBest(leaf); },
        (error) => { things.delete(lod); this.failed.push(String(error?.message ?? error)); },
      ).finally(() => { this.running--; this.next(); });
    }
    this.changed();
  }

  /** Shows the finest level of a leaf that is there, if the leaf is needed, and frees coarser ones. */
  showBest(leaf) {
    const best = this.best(leaf), things = this.held[leaf];
    for (const [lod, thing] of [...things]) {
      if (!thing) continue;
      this.player.show(thing, lod === best && this.drawn.has(leaf));
      if (lod > best) { this.player.free(thing); things.delete(lod); }
    }
  }

  release(leaf) {
    for (const [lod, thing] of [...this.held[leaf]]) {
      if (thing) { this.player.free(thing); this.held[leaf].delete(lod); }
    }
  }
}
