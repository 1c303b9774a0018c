// Where a visitor is and looks, without roll: an eye, a turn, a tilt, and how far ahead lies what is looked at.
// Turn and tilt are radians in a frame: turning right and tilting upwards are positive.

import {
  add, clamp, distance, dot, normalize, quaternionFromColumns, rotate, scale, subtract, cross,
} from "./vector.ts";
import type { Frame, Quat, Vec3 } from "./vector.ts";

export interface Rig {
  eye: Vec3;
  turn: number;
  tilt: number;
  reach: number; // distance from the eye to the pivot of orbits, above 0
  fovY: number;
}

export const MOST_TILT = Math.PI / 2 - 0.01;
export const DEGREES = Math.PI / 180;
export const FOV_DEGREES: [number, number] = [10, 120];
export const [LEAST_FOV, MOST_FOV] = [10 * DEGREES, 120 * DEGREES];
export const NORMAL_FOV = Math.PI / 3;

export function forward(rig: Rig, frame: Frame): Vec3 {
  const level = Math.cos(rig.tilt);
  const north = scale(frame.north, level * Math.cos(rig.turn));
  const east = scale(frame.east, level * Math.sin(rig.turn));
  return add(add(north, east), scale(frame.up, Math.sin(rig.tilt)));
}

export function right(rig: Rig, frame: Frame): Vec3 {
  return add(scale(frame.north, -Math.sin(rig.turn)), scale(frame.east, Math.cos(rig.turn)));
}

export function pivot(rig: Rig, frame: Frame): Vec3 {
  return add(rig.eye, scale(forward(rig, frame), rig.reach));
}

/** Return the rotation of the camera, world from camera, OpenCV axes. */
export function rotation(rig: Rig, frame: Frame): Quat {
  const x = right(rig, frame);
  const z = forward(rig, frame);
  return quaternionFromColumns(x, cross(z, x), z);
}

/** Stand at `eye` and look at `target`. */
export function rigFromTarget(eye: Vec3, target: Vec3, frame: Frame, fovY = NORMAL_FOV): Rig {
  const ahead = normalize(subtract(target, eye), frame.north);
  const reach = Math.max(distance(eye, target), 1e-6);
  const turn = Math.atan2(dot(ahead, frame.east), dot(ahead, frame.north));
  const tilt = clamp(Math.asin(clamp(dot(ahead, frame.up), -1, 1)), -MOST_TILT, MOST_TILT);
  return { eye, turn, tilt, reach, fovY: clamp(fovY, LEAST_FOV, MOST_FOV) };
}

/** Take over a camera, without its roll. Straight up or down its upper border says where the turn points. */
export function rigFromPose(eye: Vec3, turned: Quat, frame: Frame, reach: number, fovY = NORMAL_FOV): Rig {
  const ahead = normalize(rotate(turned, [0, 0, 1]));
  const rig = rigFromTarget(eye, add(eye, scale(ahead, reach)), frame, fovY);
  const climb = dot(ahead, frame.up);
  if (Math.abs(climb) > 0.9995) {
    const top = scale(rotate(turned, [0, -1, 0]), climb > 0 ? -1 : 1);
    rig.turn = Math.atan2(dot(top, frame.east), dot(top, frame.north));
  }
  return rig;
}

/** Turn the eye where it stands. */
export function look(rig: Rig, turn: number, tilt: number): Rig {
  return { ...rig, turn: rig.turn + turn, tilt: clamp(rig.tilt + tilt, -MOST_TILT, MOST_TILT) };
}

/** Turn the eye around its pivot. */
export function orbit(rig: Rig, frame: Frame, turn: number, tilt: number): Rig {
  const center = pivot(rig, frame);
  const turned = look(rig, turn, tilt);
  return { ...turned, eye: subtract(center, scale(forward(turned, frame), rig.reach)) };
}

/** Come nearer to the pivot (factor below 1) or go away from it. */
export function approach(rig: Rig, frame: Frame, factor: number, least = 1e-4, most = 1e6): Rig {
  const reach = clamp(rig.reach * factor, least, most);
  return { ...rig, reach, eye: subtract(pivot(rig, frame), scale(forward(rig, frame), reach)) };
}

/** Move by scene units to the right, upwards on the screen, and ahead. */
export function slide(rig: Rig, frame: Frame, aside: number, above: number, ahead: number): Rig {
  const x = right(rig, frame);
  const z = forward(rig, frame);
  const y = cross(x, z);
  return { ...rig, eye: add(add(rig.eye, scale(x, aside)), add(scale(y, above), scale(z, ahead))) };
}

/** Move on the level: to the right and ahead by the turn alone, and along up. */
export function walk(rig: Rig, frame: Frame, aside: number, above: number, ahead: number): Rig {
  const level = { ...rig, tilt: 0 };
  return { ...slide(level, frame, aside, above, ahead), tilt: rig.tilt };
}

/** Return the angle between -pi and pi that differs from this one by whole turns. */
export function wrap(angle: number): number {
  return angle - 2 * Math.PI * Math.round(angle / (2 * Math.PI));
}

/** A view between two, from 0 to 1: eyes on a line, turns the shorter way. */
export function between(a: Rig, b: Rig, t: number): Rig {
  return {
    eye: add(scale(a.eye, 1 - t), scale(b.eye, t)),
    turn: a.turn + wrap(b.turn - a.turn) * t,
    tilt: a.tilt + (b.tilt - a.tilt) * t,
    reach: Math.exp(Math.log(a.reach) * (1 - t) + Math.log(b.reach) * t),
    fovY: a.fovY + (b.fovY - a.fovY) * t,
  };
}

/** The same, but it is the pivots that move on a line: what is looked at stays in the middle. */
export function aroundBetween(a: Rig, b: Rig, t: number, frame: Frame): Rig {
  const mixed = between(a, b, t);
  const center = add(scale(pivot(a, frame), 1 - t), scale(pivot(b, frame), t));
  return { ...mixed, eye: subtract(center, scale(forward(mixed, frame), mixed.reach)) };
}

/** Whether two views differ by less than a person sees. */
export function alike(a: Rig, b: Rig): boolean {
  const near = 1e-5 * Math.max(a.reach, 1e-6);
  return (
    distance(a.eye, b.eye) < near && Math.abs(a.turn - b.turn) < 1e-5 && Math.abs(a.tilt - b.tilt) < 1e-5 &&
    Math.abs(a.fovY - b.fovY) < 1e-5 && Math.abs(a.reach - b.reach) < near
  );
}
