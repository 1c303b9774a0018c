// Which Gaussians make a pixel what it is: the rasterizer's formulas for one pixel, in float64 (docs/conventions.md).
import { axesOf, rotationOf } from "./camera.ts";
import type { SortedScene } from "./sorting.ts";
import { colorSeen, decodeRecord, decodeTerm, type Splat, type Tables, type Term } from "./tables.ts";
import type { Camera } from "./types.ts";

/** A Gaussian under a pixel. */
export interface Picked {
  slot: number;
  id: number;
  weight: number; // its share of the pixel
  alpha: number;
  depth: number; // along the camera's axis, scene units
  position: [number, number, number];
  scales: [number, number, number];
  opacity: number;
  level: number; // the lowest that has it
  levels: [number, number]; // the lowest and the highest
  terms: number;
  color: [number, number, number]; // RGB as the eye sees it, >= 0
}

/** What lies under a pixel: the Gaussian with the largest weight, and the next ones. */
export interface Pick extends Picked {
  others: Picked[];
  total: number; // alpha of the pixel
  count: number; // Gaussians that reach it
}

const MOST = 8;

/** Return what the pixel with the center (x, y) shows, null if nothing. */
export function pickAt(
  scene: SortedScene, tables: Tables, camera: Camera, x: number, y: number, levels: number,
): Pick | null {
  const found: { splat: Splat; alpha: number; depth: number; row: number; place: number }[] = [];
  const axes = axesOf(camera);
  scene.each(camera, { left: x, top: y, right: x, bottom: y, levels }, (records, i, row, place) => {
    const splat = decodeRecord(records, i, scene.chunks, row, tables);
    const hit = alphaAt(splat, camera, axes, x, y);
    if (hit) found.push({ splat, ...hit, row, place });
  });
  found.sort((a, b) => Math.fround(a.depth) - Math.fround(b.depth));
  let left = 1;
  const weighed: { weight: number; hit: (typeof found)[number] }[] = [];
  for (const hit of found) {
    const after = left * (1 - hit.alpha);
    if (after <= 1e-4) break;
    weighed.push({ weight: left * hit.alpha, hit });
    left = after;
  }
  if (weighed.length === 0) return null;
  weighed.sort((a, b) => b.weight - a.weight);
  const chosen = weighed.slice(0, MOST),
    terms = termsOf(scene, tables, chosen.map(({ hit }) => scene.slotAt(hit.place)));
  const best = chosen.map(({ weight, hit }, k): Picked => ({
    slot: scene.slotAt(hit.place), id: scene.idAt(hit.place), weight, alpha: hit.alpha, depth: hit.depth,
    position: hit.splat.mean, scales: hit.splat.scale, opacity: hit.splat.opacity,
    level: scene.levels[2 * hit.row], levels: [scene.levels[2 * hit.row], scene.levels[2 * hit.row + 1]],
    terms: terms[k].length, color: colorSeen(hit.splat, terms[k], camera.position, tables.variant),
  }));
  return { ...best[0], others: best.slice(1), total: 1 - left, count: found.length };
}

/** Return the terms of some slots. */
function termsOf(scene: SortedScene, tables: Tables, slots: number[]): Term[][] {
  const found = new Map<number, Term[]>(slots.map((slot) => [slot, []]));
  for (let t = 0; t < scene.termCount; t++) found.get(scene.owners[t])?.push(decodeTerm(scene.terms, t, tables));
  return slots.map((slot) => found.get(slot) ?? []);
}

/** Return alpha and depth of a Gaussian at a point of the picture, null below 1/255. */
export function alphaAt(
  splat: Splat, camera: Camera, axes: number[], px: number, py: number,
): { alpha: number; depth: number } | null {
  const { fx, fy, cx, cy, width, height, position } = camera;
  const d = splat.mean.map((value, k) => value - position[k]);
  const point = [0, 3, 6].map((k) => axes[k] * d[0] + axes[k + 1] * d[1] + axes[k + 2] * d[2]);
  const [x, y, z] = point;
  if (z <= 0.01) return null;
  const u = Math.min(Math.max(x / z, -cx / fx - (0.15 * width) / fx), (width - cx) / fx + (0.15 * width) / fx);
  const v = Math.min(Math.max(y / z, -cy / fy - (0.15 * height) / fy), (height - cy) / fy + (0.15 * height) / fy);
  const turn = rotationOf(splat.quat), m = [0, 0, 0], n = [0, 0, 0];
  for (let k = 0; k < 3; k++) {
    const s = splat.scale[k];
    const along = [0, 3, 6].map((r) => s * (axes[r] * turn[k] + axes[r + 1] * turn[3 + k] + axes[r + 2] * turn[6 + k]));
    m[k] = (fx / z) * (along[0] - u * along[2]);
    n[k] = (fy / z) * (along[1] - v * along[2]);
  }
  const xx = dot(m, m), xy = dot(m, n), yy = dot(n, n);
  const p = m[1] * n[2] - m[2] * n[1], q = m[2] * n[0] - m[0] * n[2], r = m[0] * n[1] - m[1] * n[0];
  const full = p * p + q * q + r * r + 0.3 * (xx + yy) + 0.09;
  const dx = (fx * x) / z + cx - px, dy = (fy * y) / z + cy - py;
  const sigma = (0.5 * ((yy + 0.3) * dx * dx + (xx + 0.3) * dy * dy) - xy * dx * dy) / full;
  const alpha = Math.min(splat.opacity * Math.exp(-sigma), 0.999);
  return alpha >= 1 / 255 ? { alpha, depth: z } : null;
}

function dot(a: number[], b: number[]): number {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}
