// Moves a camera along the keys of a track of settings.json, as supersplat-viewer does: cubic curves through positions,
// targets and angles. Part of the script of the timeline, which pages load where their settings have a track.

import { LONGER } from "./hash.ts";
import type { View } from "./hash.ts";
import { fields, isPositive, list, numbers } from "./json.ts";
import { textOfPage } from "./parts.ts";
import { FOV_DEGREES } from "./rig.ts";
import { clamp } from "./vector.ts";
import type { Vec3 } from "./vector.ts";

const MOST_KEYS = 100_000;
const FARTHEST = 1e6; // of a coordinate, as on the wire
const RATE = 30; // frames a second of tracks that name no rate; their times are seconds

export type Loops = "none" | "repeat" | "pingpong";

/** A track of a camera. */
export interface Tour {
  readonly duration: number; // seconds, one way
  readonly loops: Loops;
  /** Return the second of the track that is shown after some seconds, from 0 to its duration; null behind its end. */
  second(seconds: number): number | null;
  /** Return where the camera is after some seconds; null where the track has ended. */
  at(seconds: number): View | null;
}

/** Return the track that settings begin with, else their first; throw an Error where it makes no sense. */
export function readTour(settings: unknown): Tour {
  const all = fields(settings), camera = fields(all?.camera), tracks = list(all?.animTracks).map(fields);
  const track = tracks.find((each) => each?.name === camera?.animTrack) ?? tracks[0];
  const keys = fields(track?.keyframes), values = fields(keys?.values), n = list(keys?.times).length;
  const times = numbers(keys?.times, n), eyes = numbers(values?.position, 3 * n, FARTHEST);
  const targets = numbers(values?.target, 3 * n, FARTHEST);
  const fov = isPositive(camera?.fov) ? camera.fov : 60;
  const fovs = values?.fov === undefined ? new Array<number>(n).fill(fov) : numbers(values.fov, n);
  const rises = times?.every((time, k) => k === 0 || time > times[k - 1]);
  if (!track || !times || !eyes || !targets || !fovs || !rises || n < 1 || n > MOST_KEYS || !isPositive(track.duration)) {
    throw new Error(textOfPage("say.settings.track"));
  }
  const { duration } = track, loops = loopsOf(track.loopMode), rate = isPositive(track.frameRate) ? track.frameRate : RATE;
  const frames = times.map((time) => time * (isPositive(track.frameRate) ? 1 : rate));
  const points = frames.map((_, k) => [
    ...eyes.slice(3 * k, 3 * k + 3), ...targets.slice(3 * k, 3 * k + 3), clamp(fovs[k], ...FOV_DEGREES),
  ]);
  const smoothness = typeof track.smoothness === "number" ? clamp(track.smoothness, 0, 1) : 0;
  if (loops === "repeat" && n > 1) {
    // The way back to the first key takes what is left of the duration, one frame at least.
    const length = duration * rate + (duration * rate === frames[n - 1] ? 1 : 0);
    const [first, last] = [frames.slice(0, 2), frames.slice(-2)], [begin, end] = [points.slice(0, 2), points.slice(-2)];
    frames.push(...first.map((time) => time + length));
    frames.unshift(...last.map((time) => time - length));
    points.push(...begin);
    points.unshift(...end);
  }
  const own = all?.frame === "scene", turn = own ? 1 : -1;
  const place = (v: number[], from: number): Vec3 => [turn * v[from], turn * v[from + 1], v[from + 2]];
  const second = (seconds: number): number | null => {
    if (loops === "repeat") return seconds % duration;
    if (loops === "pingpong") return duration - Math.abs(duration - (seconds % (2 * duration)));
    return seconds > duration ? null : seconds;
  };
  const at = (seconds: number): View | null => {
    const now = second(seconds);
    if (now === null) return null;
    const found = along(frames, points, now * rate, track.interpolation === "step" ? null : smoothness);
    return { eye: place(found, 0), to: place(found, 3), fov: clamp(found[6], ...FOV_DEGREES), ...(own ? {} : LONGER) };
  };
  return { duration, loops, second, at };
}

function loopsOf(mode: unknown): Loops {
  return mode === "repeat" || mode === "pingpong" ? mode : "none";
}

/**
 * Return the values at a time: on cubic curves whose slope at a key is `smoothness` times that between its neighbors;
 * null for those of the last key. Before the first key and behind the last one they rest.
 */
export function along(
  times: readonly number[], points: readonly number[][], time: number, smoothness: number | null,
): number[] {
  const last = times.length - 1;
  let k = 0;
  while (k < last && times[k + 1] <= time) k++;
  if (k === last || time <= times[0] || smoothness === null) return points[k];
  const span = times[k + 1] - times[k], t = (time - times[k]) / span;
  const slope = (key: number, axis: number): number => {
    const [a, b] = [Math.max(key - 1, 0), Math.min(key + 1, last)];
    return (smoothness * span * (points[b][axis] - points[a][axis])) / (times[b] - times[a]);
  };
  return points[k].map((from, axis) => {
    const to = points[k + 1][axis], out = slope(k, axis), into = slope(k + 1, axis);
    return from + t * (out + t * (3 * (to - from) - 2 * out - into + t * (2 * (from - to) + out + into)));
  });
}
