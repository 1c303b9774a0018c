// A view as the part of an address behind `#`, for sharing: #eye=2,1.5,1.5&to=3,1.5,1.5&fov=60&mode=walk

import { MODES } from "./navigator.ts";
import type { Mode } from "./navigator.ts";
import { DEGREES, FOV_DEGREES, pivot } from "./rig.ts";
import type { Rig } from "./rig.ts";
import { clamp, distance, length } from "./vector.ts";
import type { Frame, Vec3 } from "./vector.ts";

const FARTHEST = 1e6; // of a coordinate, as on the wire

/** A view as people write it: where the eye is, what it looks at, and an angle in degrees. */
export interface View {
  eye: Vec3;
  to: Vec3;
  fov: number; // from the lower to the upper border
  longer?: boolean; // `fov` is between the borders that are farther apart, as in settings of SuperSplat
  mode?: Mode;
  name?: string;
}

/** The angle of a view in a file of SuperSplat. */
export const LONGER = { longer: true } as const;

export function writeHash(rig: Rig, frame: Frame, mode: Mode, up: Vec3 | null = null): string {
  const digits = clamp(Math.ceil(4 - Math.log10(rig.reach)), 0, 9);
  const list = (v: Vec3): string => v.map((x) => Number(x.toFixed(digits)) + 0).join(",");
  const fov = Number((rig.fovY / DEGREES).toFixed(1));
  return `#eye=${list(rig.eye)}&to=${list(pivot(rig, frame))}&fov=${fov}&mode=${mode}${up ? `&up=${up}` : ""}`;
}

/** Return the view of an address, null where it has none, and an Error where it has one that makes no sense. */
export function readHash(hash: string): View | Error | null {
  const entries = new URLSearchParams(hash.replace(/^#/, ""));
  if (!entries.has("eye") && !entries.has("to")) return null;
  const eye = readVector(entries.get("eye"));
  const to = readVector(entries.get("to"));
  if (!eye || !to) return new Error("the view in the address needs eye=x,y,z and to=x,y,z");
  if (!(distance(eye, to) > 1e-9)) return new Error("the view in the address looks at its own eye");
  const fov = Number(entries.get("fov") ?? 60);
  const view: View = { eye, to, fov: Number.isFinite(fov) ? clamp(fov, ...FOV_DEGREES) : 60 };
  const mode = MODES.find((known) => known === entries.get("mode"));
  return mode ? { ...view, mode } : view;
}

/** Return the axis that an address says to be up, null where it says none. */
export function readUp(hash: string): Vec3 | null {
  const up = readVector(new URLSearchParams(hash.replace(/^#/, "")).get("up"));
  return up && length(up) > 1e-9 ? up : null;
}

function readVector(text: string | null): Vec3 | null {
  const parts = (text ?? "").split(",");
  const [x, y, z] = parts.map((part) => (part.trim() === "" ? NaN : Number(part)));
  if (parts.length !== 3 || ![x, y, z].every((c) => Number.isFinite(c) && Math.abs(c) <= FARTHEST)) return null;
  return [x, y, z];
}
