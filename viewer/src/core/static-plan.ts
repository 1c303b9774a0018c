// What to fetch next of a static scene: blocks ranked by weight in view for each byte, cut into slices of neighbouring
// bytes.
// The rules are those of the streaming server's policy "utility" (gsvis.abr.policies); the factors are not. docs/static.md
// has one table of both and says why they differ; tests/export/test_factors.py compares it with the sources.
// The row of a neighbor is ranked alone, after the own cell, so neighbors need no factor.
import { rotationOf } from "./camera.ts";
import type { Blocks } from "./static-blocks.ts";
import { type CellRow, everything } from "./static-cells.ts";
import type { Pose, View } from "./types.ts";

export const MARGIN = 0.14; // radians by which the borders of the view move outwards
const PERIPHERAL = Math.log2(0.003), TERMS = Math.log2(0.003), FINER = Math.log2(0.1), BEYOND = Math.log2(0.05);
const RECORD = 13; // bytes of a Gaussian
const POWERS = { high: 1, medium: 1.5, low: 2 };
const HORIZON = 3, STICKY = 1.2; // seconds; change of the rate that changes the regime

export type Regime = "high" | "medium" | "low";

/** States of the records of blocks, and of items. */
export const NONE = 0, ASKED = 1, HELD = 2, LOST = 3;

/** What to fetch: records of blocks, and items, which are layers of the terms of blocks (see `Blocks.termStart`). */
export interface Order {
  blocks: Uint32Array; // or items
  terms: Uint8Array; // 1 for items
}

/** A run of neighbouring blocks or items that one request fetches. */
export interface Run {
  terms: boolean;
  first: number;
  end: number; // behind the last one
  place: number; // of its best one in the order
}

export interface Holdings {
  records: Uint8Array; // (B) states
  terms: Uint8Array; // (L B) states of items
}

/** Return the regime of a rate in bytes a second, given the bytes of each level of a cell; see `regime_of`. */
export function regimeOf(rate: number, levelBytes: readonly number[], before: Regime | null): Regime {
  const sizes: number[] = [];
  for (const size of levelBytes) sizes.push(Math.max(size, sizes[sizes.length - 1] ?? 0));
  const high = sizes[sizes.length - 1], medium = sizes[Math.max(sizes.length - 2, 0)];
  const names: Regime[] = ["high", "medium", "low"];
  const at = (budget: number): number => (budget >= high ? 0 : budget >= medium ? 1 : 2);
  let now = at(rate * HORIZON);
  const was = before === null ? now : names.indexOf(before);
  if (now !== was) {
    const held = at(now < was ? (rate * HORIZON) / STICKY : rate * HORIZON * STICKY);
    now = (held - was) * (now - was) > 0 ? held : was;
  }
  return names[now];
}

/** Return the bytes of each level that a cell sees, lowest first. */
export function levelBytes(blocks: Blocks, row: CellRow): number[] {
  const found = new Array<number>(blocks.top + 1).fill(0);
  for (const b of row.blocks) {
    const c = blocks.chunk[b];
    for (let level = blocks.levels[2 * c]; level <= blocks.levels[2 * c + 1]; level++) {
      found[level] += blocks.bytes(b, b + 1);
    }
  }
  return found;
}

/** Return five planes (normal, offset): points inside have a positive distance from all; see `FieldOfView.planes`. */
export function frustum(pose: Pose, view: View, margin = MARGIN): Float64Array {
  const turn = rotationOf(pose.rotation);
  const widest = (89 * Math.PI) / 180, planes = new Float64Array(20);
  const sides = [[view.left, 0, 1], [view.right, 0, -1], [view.up, 1, 1], [view.down, 1, -1]] as const;
  for (let k = 0; k < 5; k++) {
    const local = [0, 0, 1];
    if (k < 4) {
      const [tangent, axis, sign] = sides[k], angle = Math.min(Math.atan(tangent) + margin, widest);
      local[axis] = sign * Math.cos(angle);
      local[2] = Math.sin(angle);
    }
    for (let row = 0; row < 3; row++) {
      const v = turn[3 * row] * local[0] + turn[3 * row + 1] * local[1] + turn[3 * row + 2] * local[2];
      planes[4 * k + row] = v;
      planes[4 * k + 3] -= v * pose.position[row];
    }
  }
  return planes;
}

/** Return what is not held of the row of a cell, most useful first. For a neighbor (`adjacent`) the view does not count. */
export function rank(
  blocks: Blocks, row: CellRow, held: Holdings, pose: Pose, view: View, regime: Regime, adjacent = false,
): Order {
  const planes = frustum(pose, view), chunks = blocks.levels.length / 2, power = POWERS[regime];
  const { top, lowest } = blocks, middle = Math.max(top - 1, lowest);
  const caps = { high: [top, top], medium: [middle, middle], low: [middle, lowest] }[regime];
  const least = regime === "high" ? top : lowest;
  const far = new Float32Array(chunks).fill(NaN), inside = new Float32Array(chunks);
  const seen = row.blocks.length, wide = 1 + blocks.scene.layers; // keys of a block: of its records, of its layers
  const keys = new Float32Array(wide * seen), found: number[] = [];
  for (let k = 0; k < seen; k++) {
    const b = row.blocks[k], c = blocks.chunk[b];
    if (blocks.levels[2 * c + 1] < least) continue;
    if (Number.isNaN(far[c])) {
      const x = blocks.spheres[4 * c], y = blocks.spheres[4 * c + 1], z = blocks.spheres[4 * c + 2],
        radius = blocks.spheres[4 * c + 3];
      const away = ([px, py, pz]: readonly number[]): number =>
        Math.log2((x - px) ** 2 + (y - py) ** 2 + (z - pz) ** 2 + radius ** 2 / 4 + 1e-12);
      far[c] = away(pose.position) - (row.middle ? away(row.middle) : 0);
      let depth = 0; // how far the center is inside of all borders, at most 0
      for (let p = 0; p < 20; p += 4) {
        depth = Math.min(depth, planes[p] * x + planes[p + 1] * y + planes[p + 2] * z + planes[p + 3]);
      }
      inside[c] = Math.max(0, 1 + depth / (radius || 1)); // 1 if the center is in view, 0 if nothing is
    }
    let factor = -far[c];
    if (!adjacent) factor += power * PERIPHERAL * (1 - inside[c]) + (blocks.levels[2 * c] > 0 ? FINER : 0);
    if (blocks.levels[2 * c] > caps[inside[c] && !adjacent ? 0 : 1]) factor += BEYOND;
    if (held.records[b] === NONE) {
      keys[wide * k] = row.gains[k] + factor - Math.log2(blocks.size(b));
      found.push(wide * k);
    }
    if (adjacent || blocks.termStart === null || held.records[b] === LOST) continue;
    for (let layer = 0; layer < wide - 1; layer++) {
      const item = layer * blocks.count + b, bytes = blocks.bytes(item, item + 1, true);
      const gain = row.items?.[layer * seen + k] ?? row.gains[k] + TERMS;
      if (bytes === 0 || gain === -Infinity || held.terms[item] !== NONE) continue;
      keys[wide * k + layer + 1] = gain + factor - Math.log2(bytes / RECORD);
      found.push(wide * k + layer + 1);
    }
  }
  const order = Uint32Array.from(found).sort((a, b) => keys[b] - keys[a] || a - b);
  return {
    blocks: order.map((entry) => row.blocks[Math.floor(entry / wide)] + Math.max(entry % wide - 1, 0) * blocks.count),
    terms: Uint8Array.from(order, (entry) => (entry % wide ? 1 : 0)),
  };
}

/**
 * Return a row for an eye outside of its cell: with all blocks, those that the cell does not see at a share of what they
 * would add if nothing hid them. The share rises with the distance, see gsvis.abr.outside. Inside the row is unchanged.
 */
export function widen(blocks: Blocks, row: CellRow, size: number, eye: readonly number[]): CellRow {
  const { middle } = row, wide = everything(blocks.scene), { layers } = blocks.scene;
  const away = middle ? Math.hypot(...middle.map((v, k) => Math.max(Math.abs(v - eye[k]) / size - 0.5, 0))) : 0;
  if (away < 1e-6) return row;
  const items = new Float32Array(layers * blocks.count);
  let own = 0;
  wide.gains.forEach((_, b) => {
    const [x, y, z, radius] = blocks.spheres.subarray(4 * blocks.chunk[b]), [p, q, r] = middle!;
    const sees = row.blocks[own] === b, share = away / (1 + away) * radius / Math.hypot(x - p, y - q, z - r, radius / 2);
    const gain = wide.gains[b] = sees ? row.gains[own] : 2 * Math.log2(share);
    for (let layer = 0; layer < layers; layer++) {
      items[layer * blocks.count + b] = sees && row.items ? row.items[layer * row.blocks.length + own] : gain + TERMS;
    }
    if (sees) own++;
  });
  return { ...wide, items, middle };
}

/**
 * Return the next runs of an order, of about `budget` bytes, and the entry behind them. Blocks between two runs join
 * them where they take at most `gap` bytes and are not held: that is cheaper than another request.
 */
export function slice(
  blocks: Blocks, order: Order, from: number, held: Holdings, budget: number, gap: number,
): { runs: Run[]; next: number } {
  const chosen: [number[], number[]] = [[], []],
    places: [Map<number, number>, Map<number, number>] = [new Map(), new Map()];
  let size = 0, next = from;
  for (; next < order.blocks.length && size < budget; next++) {
    const b = order.blocks[next], kind = order.terms[next] as 0 | 1, states = kind ? held.terms : held.records;
    if (states[b] !== NONE) continue;
    states[b] = ASKED;
    chosen[kind].push(b);
    places[kind].set(b, next);
    size += blocks.bytes(b, b + 1, kind === 1);
  }
  const runs: Run[] = [];
  for (const kind of [0, 1] as const) {
    const states = kind ? held.terms : held.records;
    let last: Run | null = null;
    for (const b of chosen[kind].sort((p, q) => p - q)) {
      if (last !== null && joins(blocks, last, b, held, gap)) {
        for (let k = last.end; k < b; k++) states[k] = ASKED;
        last.end = b + 1;
        last.place = Math.min(last.place, places[kind].get(b)!);
      } else {
        last = { terms: kind === 1, first: b, end: b + 1, place: places[kind].get(b)! };
        runs.push(last);
      }
    }
  }
  return { runs: runs.sort((a, b) => a.place - b.place), next };
}

function joins(blocks: Blocks, run: Run, block: number, held: Holdings, gap: number): boolean {
  if (blocks.bytes(run.end, block, run.terms) > gap) return false;
  for (let k = run.end; k < block; k++) {
    if (
      run.terms ? held.terms[k] !== NONE ||
      (held.records[k % blocks.count] !== HELD && held.records[k % blocks.count] !== ASKED) : held.records[k] !== NONE
    ) {
      return false;
    }
  }
  return true;
}
