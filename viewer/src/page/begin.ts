// Chooses how a visit begins: the view of the address, else the first of the settings, else a good place in the scene.

import type { Header } from "../core/types.ts";
import { startInCells, startOnFloor, surroundedBy } from "./start.ts";
import type { Cells, Facts } from "./facts.ts";
import type { Floor } from "./ground.ts";
import { readHash } from "./hash.ts";
import type { View } from "./hash.ts";
import { BAD_HASH, FAR_HASH } from "./messages.ts";
import type { Mode } from "./navigator.ts";
import { DEGREES, NORMAL_FOV, rigFromTarget } from "./rig.ts";
import type { Rig } from "./rig.ts";
import { add, distance, scale } from "./vector.ts";
import type { Frame, Vec3 } from "./vector.ts";

const PATIENCE = 2500; // milliseconds that a first picture waits for facts
const FAR = 20; // sizes of the scene's cells

export interface Surroundings {
  floor: Floor | null;
  cells: Cells | null;
}

export interface Beginning {
  rig: Rig;
  mode: Mode;
  problem: string | null;
}

export const rigFromView = (view: View, frame: Frame): Rig => rigFromTarget(view.eye, view.to, frame, view.fov * DEGREES);

/** Ask for floor and cells; what does not come in time counts as unknown. */
export async function survey(facts: Facts): Promise<Surroundings> {
  const late = new Promise<null>((done) => setTimeout(done, PATIENCE, null));
  const [floor, cells] = await Promise.all([Promise.race([facts.floor(), late]), Promise.race([facts.cells(), late])]);
  return { floor, cells };
}

export function begin(hash: string, views: readonly View[], frame: Frame, { floor, cells }: Surroundings): Beginning {
  const asked = readHash(hash);
  const around = cells !== null && surroundedBy(cells, frame) !== null;
  const mode: Mode = around ? "orbit" : floor ? "walk" : cells ? "fly" : "orbit";
  const first = firstRig(views, frame, floor, cells);
  if (asked instanceof Error) return { rig: first, mode, problem: BAD_HASH };
  if (!asked) return { rig: first, mode, problem: null };
  if (cells && isFar(asked.eye, cells)) return { rig: first, mode, problem: FAR_HASH };
  return { rig: rigFromView(asked, frame), mode: asked.mode ?? mode, problem: null };
}

/** Return the scene units in a meter: as the header says, or so that the cells are about ten meters wide. */
export function guessMeter(header: Header, cells: Cells | null): number {
  if (header.metersPerUnit > 0) return 1 / header.metersPerUnit;
  return cells ? Math.max(extent(cells), 1e-3) / 10 : 1;
}

function firstRig(views: readonly View[], frame: Frame, floor: Floor | null, cells: Cells | null): Rig {
  if (views.length) return rigFromView(views[0], frame);
  const center = cells && surroundedBy(cells, frame);
  const inside = cells && startInCells(cells, frame);
  if (center && inside) return rigFromTarget(inside.eye, center, frame, NORMAL_FOV);
  return (floor && startOnFloor(floor, frame)) ?? inside ?? rigFromTarget([0, 0, 0], frame.north, frame, NORMAL_FOV);
}

function isFar(eye: Vec3, cells: Cells): boolean {
  const middle = add(cells.origin, scale(cells.boxes.reduce(add, [0, 0, 0]), cells.size / Math.max(cells.boxes.length, 1)));
  return distance(eye, middle) > FAR * extent(cells);
}

function extent(cells: Cells): number {
  const sides = [0, 1, 2].map((k) => {
    const places = cells.boxes.map((box) => box[k]);
    return (Math.max(...places) - Math.min(...places) + 1) * cells.size;
  });
  return Math.hypot(...sides);
}
