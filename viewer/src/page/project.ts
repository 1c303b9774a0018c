// Where a point of the scene stands in the picture of a view.

import { DEGREES } from "./rig.ts";
import type { View } from "./hash.ts";
import { cross, dot, normalize, subtract } from "./vector.ts";
import type { Vec3 } from "./vector.ts";

/** A place in a picture: CSS pixels from its upper left corner, and scene units along the axis of the camera. */
export interface Place {
  x: number;
  y: number;
  depth: number;
}

/** Return where a point is drawn, perhaps outside of the picture; null for one that is not in front of the eye. */
export function project(point: Vec3, view: View, up: Vec3, width: number, height: number): Place | null {
  const ahead = normalize(subtract(view.to, view.eye)), right = normalize(cross(ahead, up));
  const offset = subtract(point, view.eye), depth = dot(offset, ahead);
  if (!(depth > 1e-9)) return null;
  const focal = height / 2 / Math.tan((view.fov * DEGREES) / 2) / depth;
  return {
    x: width / 2 + focal * dot(offset, right), y: height / 2 - focal * dot(offset, cross(right, ahead)), depth,
  };
}
