// What a streamed SOG costs and shows, leaf by leaf, from the sidecar that `gsvis export --format streamed-sog` writes.
// No dependencies. docs/streamed.md describes the sidecar to the byte.
//
//   const scene = await NeededLeaves.open("scene/");
//   const { load, keep, hide } = scene.plan([x, y, z], [dx, dy, dz]);  // numbers of leaves

const ROOTS = [1, 1.189207115002721, 1.4142135623730951, 1.681792830507429]; // written out: the same in every language

/** Returns 2 to the power of so many quarters. */
export const power = (quarters) => ROOTS[((quarters % 4) + 4) % 4] * 2 ** Math.floor(quarters / 4);

/** Returns the 32-bit FNV-1a sum of the names of all files, which hold hashes of their contents. */
const sceneSum = (names) => new TextEncoder().encode(names.join("\n")).reduce((sum, byte) => Math.imul(sum ^ byte, 0x01000193) >>> 0, 0x811c9dc5);

/** A streamed scene: its leaves, and what each cell needs. Positions are in the frame of the scene. */
export class NeededLeaves {
  /** Reads `lod-meta.json` in a folder (an address that ends in "/"), and the sidecar that it names. */
  static async open(folder) {
    const get = async (name) => {
      const answer = await fetch(folder + name);
      if (!answer.ok) throw new Error(`${folder}${name}: HTTP ${answer.status}`);
      return answer;
    };
    const meta = await (await get("lod-meta.json")).json();
    const sidecar = meta.gsvis?.files?.find((name) => name.startsWith("leaves-"));
    if (!sidecar) throw new Error(`${folder}lod-meta.json names no sidecar: write it with gsvis export --format streamed-sog`);
    return new NeededLeaves(folder, meta, await (await get(sidecar)).arrayBuffer());
  }

  constructor(folder, meta, sidecar) {
    /** Leaves in the order of the tree: bounds; for each level of detail, finest first, its SOG (null: empty) and its error. */
    this.leaves = [];
    const walk = (node) => {
      for (const child of node.children ?? []) walk(child);
      if (!node.lods) return;
      const { min, max } = node.bound;
      const center = min.map((low, k) => (low + max[k]) / 2);
      const radius = Math.hypot(...center.map((c, k) => max[k] - c));
      const lods = Array.from({ length: meta.lodLevels }, (_, k) => node.lods[k])
        .map((run) => run ? { url: folder + meta.filenames[run.file], count: run.count } : null);
      this.leaves.push({ min, max, center, radius, lods, errors: [] });
    };
    walk(meta.tree);
    /** Address of the Gaussians that are always drawn, or null. */
    this.environment = meta.environment ? folder + meta.environment : null;
    const view = new DataView(sidecar), length = view.getUint32(0, true);
    /** What the sidecar says of itself: name, up, poses, leaves, levels, absent, cells, rows, origin, size, top. */
    this.header = JSON.parse(new TextDecoder().decode(new Uint8Array(sidecar, 4, length)));
    const { format, version, scene, leaves, levels, cells, rows } = this.header;
    if (format !== "gsvis-leaves" || version !== 2) throw new Error(`a sidecar of ${format} ${version}, not gsvis-leaves 2: export the scene again`);
    if (leaves !== this.leaves.length || levels !== meta.lodLevels || scene !== sceneSum(meta.filenames)) {
      throw new Error(`a sidecar of another scene: export the scene and its sidecar together`);
    }
    this.cells = new Map();
    let at = 4 + length;
    for (let k = 0; k < levels * leaves; k++) {
      const leaf = this.leaves[k % leaves], lod = Math.floor(k / leaves), byte = view.getUint8(at + 8 * levels * leaves + k);
      if (view.getUint32(at + 4 * k, true) !== (leaf.lods[lod]?.count ?? 0)) throw new Error("a sidecar of another scene: counts differ");
      leaf.errors[lod] = byte && power(byte - 255);
      if (leaf.lods[lod]) leaf.lods[lod].bytes = view.getUint32(at + 4 * (levels * leaves + k), true);
    }
    at += 9 * levels * leaves;
    for (let k = 0; k < cells; k++, at += 8) {
      const [x, y, z, row] = [0, 2, 4, 6].map((byte) => view.getUint16(at + byte, true));
      this.cells.set(`${x},${y},${z}`, { box: [x, y, z], row });
    }
    const bytes = new Uint8Array(sidecar);
    this.rows = Array.from({ length: rows }, () => {
      const lights = new Uint8Array(leaves);
      let next = at + Math.ceil(leaves / 8);
      for (let leaf = 0; leaf < leaves; leaf++) {
        if (bytes[at + (leaf >> 3)] >> (leaf & 7) & 1) lights[leaf] = bytes[next++];
      }
      at = next;
      return lights; // 0: not needed; each 4 steps stand for twice the light
    });
    if (at !== bytes.length) throw new Error(`a sidecar of ${bytes.length} bytes where ${at} were expected`);
  }

  /** Returns the cell of a position, or the nearest one within two cells; null far outside of all. */
  cellAt(position) {
    const { origin, size } = this.header;
    if (!this.cells.size) return null;
    const place = position.map((p, k) => (p - origin[k]) / size);
    const exact = this.cells.get(place.map(Math.floor).join());
    if (exact) return exact;
    let best = null, least = 4; // squared distance to the box, in cells
    for (const cell of this.cells.values()) {
      const apart = place.reduce((sum, p, k) => sum + Math.max(cell.box[k] - p, p - cell.box[k] - 1, 0) ** 2, 0);
      if (apart < least) [best, least] = [cell, apart];
    }
    return best;
  }

  /** Returns what to do with each leaf for an eye. `forward` (optional) puts leaves that are ahead first.
   *
   * load: what the cell needs, in the order to load it; draw these as soon as they are there.
   * keep: what neighboring cells need besides, in order; do not draw it, but keep it, or load it when nothing else is to do.
   * hide: all others; do not draw them, and free them where memory is short. */
  plan(position, forward = null) {
    const cell = this.cellAt(position), row = this.rows[cell?.row ?? 0];
    const near = new Uint8Array(row.length);
    for (const other of cell ? this.neighbors(cell) : []) {
      this.rows[other.row].forEach((light, leaf) => { if (light > near[leaf]) near[leaf] = light; });
    }
    const load = [], keep = [], hide = [];
    row.forEach((light, leaf) => (light ? load : near[leaf] ? keep : hide).push(leaf));
    const worth = new Map(load.map((leaf) => [leaf, row[leaf] + this.ahead(leaf, position, forward)]));
    load.sort((a, b) => worth.get(b) - worth.get(a) || a - b);
    keep.sort((a, b) => near[b] - near[a] || a - b);
    return { cell, load, keep, hide };
  }

  /** Returns the cells that touch a cell. */
  neighbors({ box }) {
    const found = [];
    for (let k = 0; k < 27; k++) {
      const step = [k % 3, Math.floor(k / 3) % 3, Math.floor(k / 9)].map((s, axis) => box[axis] + s - 1);
      const cell = k === 13 ? null : this.cells.get(step.join());
      if (cell) found.push(cell);
    }
    return found;
  }

  /** Returns 256 for a leaf that reaches into the 120 degrees ahead of an eye, 0 for any other. */
  ahead(leaf, position, forward) {
    if (!forward) return 0;
    const { center, radius } = this.leaves[leaf], away = center.map((c, k) => c - position[k]);
    const distance = Math.hypot(...away);
    if (distance <= radius) return 256;
    const cosine = away.reduce((sum, a, k) => sum + a * forward[k], 0) / (distance * Math.hypot(...forward));
    return Math.acos(Math.min(1, Math.max(-1, cosine))) - Math.asin(radius / distance) < Math.PI / 3 ? 256 : 0;
  }
}
