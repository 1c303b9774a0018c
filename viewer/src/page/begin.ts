// Chooses how a visit begins: the view of the address, else the first of the settings, else a good place in the scene.

import type { Header } from "../core/types.ts";
import { startInCells, startOnFloor, surroundedBy } from "./start.ts";
import type { Cells, Facts, StartPose } from "./facts.ts";
import type { Floor } from "./ground.ts";
import { readHash } from "./hash.ts";
import type { View } from "./hash.ts";
import type { Mode } from "./navigator.ts";
import { DEGREES, NORMAL_FOV, rigFromPose, rigFromTarget } from "./rig.ts";
import type { Rig } from "./rig.ts";
import { add, boundsOf, distance, rotate, scale } from "./vector.ts";
import type { Frame, Vec3 } from "./vector.ts";
import { text } from "./words.ts";

const PATIENCE = 2500; // milliseconds that a first picture waits for facts
const REACH = 3; // scene units ahead of a proposed view, until it is known what lies there
const LEAST_ACROSS = Math.tan(20 * DEGREES); // half of what a window shows from side to side
const FAR = 20; // sizes of the scene's cells

export interface Surroundings {
  floor: Floor | null;
  cells: Cells | null;
  poses: readonly StartPose[]; // views that the scene itself proposes
}

export interface Beginning {
  rig: Rig;
  mode: Mode;
  problem: string | null;
  view: Pick<View, "fov" | "longer">; // whose angle it has
  focused: boolean; // whether it is known how far away lies what is looked at
}

export const rigFromView = (view: View, frame: Frame): Rig => rigFromTarget(view.eye, view.to, frame, fovOf(view));

/** Return the angle of a view from the lower to the upper border of the window, radians; narrow windows see more. */
export function fovOf({ fov, longer }: Pick<View, "fov" | "longer">): number {
  const { innerWidth, innerHeight } = globalThis, aspect = innerWidth / innerHeight || 1;
  const half = Math.tan((fov * DEGREES) / 2), least = longer ? 0 : Math.min(half, LEAST_ACROSS);
  return 2 * Math.atan(longer && aspect > 1 ? half / aspect : Math.max(half, least / aspect));
}

/** Return views that the scene proposes as people write them. */
export function viewsFromPoses(poses: readonly StartPose[]): View[] {
  return poses.map(({ position, rotation, reach }) => {
    const ahead = scale(rotate(rotation, [0, 0, 1]), reach ?? REACH);
    return { eye: position, to: add(position, ahead), fov: NORMAL_FOV / DEGREES };
  });
}

/** Ask for floor, cells and views; what does not come in time counts as unknown. */
export async function survey(facts: Facts): Promise<Surroundings> {
  const late = facts.begun.then(() => new Promise<null>((done) => setTimeout(done, PATIENCE, null)));
  const [floor, cells, poses] = await Promise.all([
    Promise.race([facts.floor(), late]), Promise.race([facts.cells(), late]), Promise.race([facts.views(), late]),
  ]);
  return { floor, cells, poses: poses ?? [] };
}

export function begin(hash: string, views: readonly View[], frame: Frame, around: Surroundings): Beginning {
  const { floor, cells } = around;
  const asked = readHash(hash);
  const outside = cells ? surroundedBy(cells, frame) !== null : !floor;
  const proposed = cells || floor ? null : (around.poses[0]?.mode ?? null);
  const mode: Mode = proposed ?? (outside ? "orbit" : floor ? "walk" : "fly");
  const focused = views.length > 0 || (around.poses[0] ? around.poses[0].reach !== undefined : cells !== null && outside);
  const view = views[0] ?? { fov: NORMAL_FOV / DEGREES };
  const first = { rig: firstRig(views, frame, around), view, mode, focused, problem: null };
  if (asked instanceof Error) return { ...first, problem: text("say.hash") };
  if (!asked) return first;
  if (cells && isFar(asked.eye, cells)) return { ...first, problem: text("say.far") };
  return { rig: rigFromView(asked, frame), view: asked, mode: asked.mode ?? mode, problem: null, focused: true };
}

/** Return the scene units in a meter: as the header says, or so that the cells are about ten meters wide. */
export function guessMeter(header: Header, cells: Cells | null): number {
  if (header.metersPerUnit > 0) return 1 / header.metersPerUnit;
  return cells ? Math.max(extent(cells), 1e-3) / 10 : 1;
}

function firstRig(views: readonly View[], frame: Frame, { floor, cells, poses }: Surroundings): Rig {
  if (views.length) return rigFromView(views[0], frame);
  const rig = rigWithin(frame, { floor, cells, poses });
  return { ...rig, fovY: fovOf({ fov: NORMAL_FOV / DEGREES }) };
}

/** Return a view that the scene proposes, or one from a good place in it. */
function rigWithin(frame: Frame, { floor, cells, poses }: Surroundings): Rig {
  if (poses.length) return rigFromPose(poses[0].position, poses[0].rotation, frame, poses[0].reach ?? REACH);
  const center = cells && surroundedBy(cells, frame);
  const inside = cells && startInCells(cells, frame);
  if (center && inside) return rigFromTarget(inside.eye, center, frame, NORMAL_FOV);
  return (floor && startOnFloor(floor, frame)) ?? inside ?? rigFromTarget([0, 0, 0], frame.north, frame, NORMAL_FOV);
}

function isFar(eye: Vec3, cells: Cells): boolean {
  const middle = add(
    cells.origin, scale(cells.boxes.reduce(add, [0, 0, 0]), cells.size / Math.max(cells.boxes.length, 1)),
  );
  return distance(eye, middle) > FAR * extent(cells);
}

function extent(cells: Cells): number {
  const sides = [0, 1, 2].map((k) => {
    const [low, high] = boundsOf(cells.boxes.map((box) => box[k]));
    return (high - low + 1) * cells.size;
  });
  return Math.hypot(...sides);
}
