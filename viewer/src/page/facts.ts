// What a server knows of a scene beside its Gaussians: cells, the floor, and why a Gaussian is there. Static scenes have
// cells, floor and views in files.
// Everything is checked here: a server of another version costs a panel, never the picture.

import type { Marks, Pose } from "../core/types.ts";
import type { Floor } from "./ground.ts";
import { fields, isPositive, list, numbers, vector } from "./json.ts";
import { normalize } from "./vector.ts";
import type { Vec3 } from "./vector.ts";
import { readWalk } from "./walk.ts";
import type { WalkGrid } from "./walk.ts";

/** A view that a scene proposes, and if that is known how to move from there, and how far away is what it looks at. */
export interface StartPose extends Pose {
  mode?: "orbit" | "fly";
  reach?: number;
}

export interface Cells {
  origin: Vec3;
  size: number;
  boxes: Vec3[]; // places in the grid
}

export interface Sight {
  cell: number;
  weight: [number, number] | null; // least and most share of a pixel
}

export interface Why {
  cells: { of: number; seeing: Sight[] } | null;
  directions: { of: number; seen: Vec3[] } | null; // unit vectors from the Gaussian to the eyes
}

const MOST_POSES = 99;
const MOST_PLACE = 1e9; // of a box in the grid
const MOST_CELLS = 100_000; // of more nothing is said
const MOST_SQUARES = 1 << 24; // of a floor
const MOST_DIRECTIONS = 1000;
const MOST_KEPT = 200; // answers

export class Facts {
  readonly #kept = new Map<string, Promise<unknown>>();

  /**
   * `base` is an address that ends with a slash, null where no server can be asked; `held` are answers from files; `begun`
   * settles when there is anything to wait for: a scene may still be written.
   */
  constructor(
    private readonly base: string | null, private readonly held: Promise<unknown> = Promise.resolve(null),
    readonly begun: Promise<unknown> = Promise.resolve(),
  ) {}

  get known(): boolean {
    return this.base !== null;
  }

  async floor(): Promise<Floor | null> {
    return readFloor(await this.#ask("floor"));
  }

  async cells(): Promise<Cells | null> {
    return readCells(await this.#ask("cells"));
  }

  /** Views that the scene proposes, the best first. */
  async views(): Promise<StartPose[]> {
    return readPoses(fields(await this.#ask("cells"))?.views);
  }

  /** How widely each Gaussian is seen, and how strongly. */
  async marks(): Promise<Marks | null> {
    const it = fields(await this.#ask("seen"));
    try {
      return it && { visibility: readBytes(it.cells), weight: readBytes(it.weights) };
    } catch {
      return null; // no base64
    }
  }

  /** Where a walker can be; null where that is not known. */
  async walk(): Promise<WalkGrid | null> {
    try {
      const said = await this.#ask("walk"); // the address of a file, or its bytes
      const packed = typeof said === "string" ? await fetch(said) : new Response(readBytes(fields(said)?.packed));
      const plain = packed.body!.pipeThrough(new DecompressionStream("deflate"));
      return readWalk(new Uint8Array(await new Response(plain).arrayBuffer()));
    } catch {
      return null;
    }
  }

  async why(id: number): Promise<Why | null> {
    return readWhy(await this.#ask(`why/${id}`));
  }

  #ask(path: string): Promise<unknown> {
    if (!this.base) return this.held.then((held) => fields(held)?.[path]);
    const known = this.#kept.get(path);
    if (known) return known;
    const answer = fetch(this.base + path, { headers: { accept: "application/json" } })
      .then((response): unknown => {
        if (response.ok) return response.json();
        if (response.status !== 404) this.#kept.delete(path); // not known for good: asked again
        return null;
      })
      .catch(() => {
        this.#kept.delete(path);
        return null;
      });
    if (this.#kept.size >= MOST_KEPT) this.#kept.clear();
    this.#kept.set(path, answer);
    return answer;
  }
}

export function readFloor(json: unknown): Floor | null {
  const it = fields(json);
  if (!it) return null;
  const [origin, first, second, up] = [it.origin, it.first, it.second, it.up].map((value) => vector(value));
  const { side, columns, rows, heights } = it;
  if (!origin || !first || !second || !up || !isPositive(side) || !isCount(columns) || !isCount(rows)) return null;
  if (!Array.isArray(heights) || heights.length !== columns * rows || heights.length > MOST_SQUARES) return null;
  const levels = Float32Array.from(heights, (height) => (typeof height === "number" ? height : NaN));
  return levels.some(Number.isFinite) ? { origin, side, first, second, up, columns, rows, heights: levels } : null;
}

/** Return cells; null where there are none, too many, or one that is no box: other answers count them. */
export function readCells(json: unknown): Cells | null {
  const it = fields(json);
  const origin = vector(it?.origin), boxes = list(it?.boxes, MOST_CELLS + 1).map((box) => vector(box, MOST_PLACE));
  if (!it || !origin || !isPositive(it.size) || boxes.length === 0 || boxes.length > MOST_CELLS) return null;
  return boxes.includes(null) ? null : { origin, size: it.size, boxes: boxes as Vec3[] };
}

/** Return the poses in a list; what is none is left out. */
export function readPoses(json: unknown): StartPose[] {
  return list(json, MOST_POSES).flatMap((each) => {
    const it = fields(each), position = vector(it?.position);
    const rotation = numbers(it?.rotation, 4) as Pose["rotation"] | null;
    if (!it || !position || !rotation) return [];
    return [{
      position, rotation, ...(it.mode === "orbit" || it.mode === "fly" ? { mode: it.mode } : {}),
      ...(isPositive(it.reach) ? { reach: it.reach } : {}),
    }];
  });
}

export function readWhy(json: unknown): Why | null {
  const it = fields(json);
  if (!it) return null;
  const [cells, directions] = [fields(it.cells), fields(it.directions)];
  const seeing = list(cells?.seeing, MOST_CELLS).map(readSight).filter((sight): sight is Sight => sight !== null);
  const seen = list(directions?.seen, MOST_DIRECTIONS).map(
    (one) => vector(Array.isArray(one) && Array.isArray(one[0]) ? one[0] : one),
  );
  return {
    cells: cells && isPositive(cells.of) ? { of: cells.of, seeing } : null,
    directions: directions && isPositive(directions.of)
      ? {
        of: directions.of, seen: seen.filter((one): one is Vec3 => one !== null).map((one) => normalize(one)),
      } : null,
  };
}

function readSight(json: unknown): Sight | null {
  const it = fields(json);
  if (typeof it?.cell !== "number") return null;
  return { cell: it.cell, weight: numbers(it.weight, 2) as [number, number] | null };
}

function readBytes(base64: unknown): Uint8Array<ArrayBuffer> {
  return Uint8Array.from(atob(String(base64)), (letter) => letter.charCodeAt(0));
}

/** Whether a value is a whole number above 0. */
function isCount(value: unknown): value is number {
  return isPositive(value) && Number.isInteger(value);
}
