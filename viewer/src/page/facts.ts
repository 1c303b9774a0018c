// What a server knows of a scene beside its Gaussians: cells, the floor, and why a Gaussian is there.
// Everything is checked here: a server of another version costs a panel, never the picture.

import type { Pose } from "../core/types.ts";
import type { Floor } from "./ground.ts";
import { normalize } from "./vector.ts";
import type { Vec3 } from "./vector.ts";

/** A view that a scene proposes, and how to move from there, if that is known. */
export interface StartPose extends Pose {
  mode?: "orbit" | "fly";
}

export interface Cells {
  origin: Vec3;
  size: number;
  boxes: Vec3[]; // places in the grid
}

export interface Sight {
  cell: number;
  distance: number;
  weight: [number, number] | null; // least and most share of a pixel
}

export interface Why {
  cells: { of: number; seeing: Sight[] } | null;
  directions: { of: number; seen: Vec3[] } | null; // unit vectors from the Gaussian to the eyes
}

const MOST_POSES = 99;

type Fields = Record<string, unknown>;

export class Facts {
  private readonly kept = new Map<string, Promise<unknown>>();

  /** `base` is an address that ends with a slash, null where there is no server to ask. */
  constructor(private readonly base: string | null) {}

  get known(): boolean {
    return this.base !== null;
  }

  async floor(): Promise<Floor | null> {
    return readFloor(await this.ask("floor"));
  }

  async cells(): Promise<Cells | null> {
    return readCells(await this.ask("cells"));
  }

  /** Views that the package proposes, the best first. */
  async views(): Promise<StartPose[]> {
    return readPoses(fields(await this.ask("cells"))?.views);
  }

  async why(id: number): Promise<Why | null> {
    return readWhy(await this.ask(`why/${id}`));
  }

  private ask(path: string): Promise<unknown> {
    if (!this.base) return Promise.resolve(null);
    const known = this.kept.get(path);
    if (known) return known;
    const answer = fetch(this.base + path, { headers: { accept: "application/json" } })
      .then((response): unknown => (response.ok ? response.json() : null))
      .catch(() => null);
    if (this.kept.size > 200) this.kept.clear();
    this.kept.set(path, answer);
    return answer;
  }
}

export function readFloor(json: unknown): Floor | null {
  const it = fields(json);
  if (!it) return null;
  const [origin, first, second, up] = [it.origin, it.first, it.second, it.up].map(vector);
  const { side, columns, rows, heights } = it;
  if (!origin || !first || !second || !up || !positive(side) || !positive(columns) || !positive(rows)) return null;
  if (!Array.isArray(heights) || heights.length !== columns * rows) return null;
  const levels = Float32Array.from(heights, (height) => (typeof height === "number" ? height : NaN));
  return levels.some(Number.isFinite) ? { origin, side, first, second, up, columns, rows, heights: levels } : null;
}

export function readCells(json: unknown): Cells | null {
  const it = fields(json);
  const origin = vector(it?.origin);
  if (!it || !origin || !positive(it.size) || !Array.isArray(it.boxes)) return null;
  return { origin, size: it.size, boxes: it.boxes.map(vector).filter((box): box is Vec3 => box !== null) };
}

/** Return the poses in a list; what is none is left out. */
export function readPoses(json: unknown): StartPose[] {
  const numbers = (value: unknown, count: number): boolean => Array.isArray(value) && value.length === count && value.every((x) => Number.isFinite(x));
  return (Array.isArray(json) ? json.slice(0, MOST_POSES) : []).flatMap((each) => {
    const it = fields(each);
    if (!it || !numbers(it.position, 3) || !numbers(it.rotation, 4)) return [];
    const mode: Pick<StartPose, "mode"> = it.mode === "orbit" || it.mode === "fly" ? { mode: it.mode } : {};
    return [{ position: it.position as Vec3, rotation: it.rotation as Pose["rotation"], ...mode }];
  });
}

export function readWhy(json: unknown): Why | null {
  const it = fields(json);
  if (!it) return null;
  const [cells, directions] = [fields(it.cells), fields(it.directions)];
  const seeing = (Array.isArray(cells?.seeing) ? cells.seeing : []).map(readSight).filter((sight): sight is Sight => sight !== null);
  const seen = (Array.isArray(directions?.seen) ? directions.seen : []).map((one) => vector(Array.isArray(one?.[0]) ? one[0] : one));
  return {
    cells: cells && positive(cells.of) ? { of: cells.of, seeing } : null,
    directions: directions && positive(directions.of)
      ? { of: directions.of, seen: seen.filter((one): one is Vec3 => one !== null).map((one) => normalize(one)) } : null,
  };
}

function readSight(json: unknown): Sight | null {
  const it = fields(json);
  if (typeof it?.cell !== "number" || typeof it.distance !== "number") return null;
  const weight = it.weight;
  const known = Array.isArray(weight) && weight.length === 2 && weight.every((x) => typeof x === "number");
  return { cell: it.cell, distance: it.distance, weight: known ? (weight as [number, number]) : null };
}

function fields(value: unknown): Fields | null {
  return typeof value === "object" && value !== null && !Array.isArray(value) ? (value as Fields) : null;
}

function vector(value: unknown): Vec3 | null {
  return Array.isArray(value) && value.length === 3 && value.every((x) => Number.isFinite(x)) ? (value as Vec3) : null;
}

function positive(value: unknown): value is number {
  return typeof value === "number" && Number.isFinite(value) && value > 0;
}
