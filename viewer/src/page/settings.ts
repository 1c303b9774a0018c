// Reads settings.json as supersplat-viewer has it (versions 1 and 2): first views, annotations, background, and whether
// there is an animation.
// Its frame is the scene's, turned by 180 degrees around z, and its angles cover the longer side of the window;
// `"frame": "scene"` says that positions are the scene's own, and angles go from the lower to the upper border.

import { LONGER } from "./hash.ts";
import type { View } from "./hash.ts";
import { fields, list, vector } from "./json.ts";
import { FOV_DEGREES } from "./rig.ts";
import { clamp, distance } from "./vector.ts";
import type { Vec3 } from "./vector.ts";
import { text } from "./words.ts";

export interface Settings {
  views: View[];
  background: Vec3 | null; // 0 to 1
  spots: boolean; // there are annotations with a place, which `hotspots.ts` reads
  animated: boolean; // there is a track, which `tour.ts` reads
  plays: boolean; // from the start
}

const MOST_VIEWS = 99;
const FARTHEST = 1e6; // of a coordinate, as on the wire

/** Return what the viewer can use of settings; throw an Error that says what is wrong. */
export function readSettings(json: unknown): Settings {
  const all = fields(json);
  if (!all) throw new Error(text("say.settings.object"));
  if (all.version !== undefined && all.version !== 1 && all.version !== 2) {
    throw new Error(text("say.settings.version", { version: String(all.version).slice(0, 20) }));
  }
  const own = all.frame === "scene";
  const views: View[] = [];
  for (const camera of all.version === 2 ? list(all.cameras, MOST_VIEWS) : [all.camera]) {
    addView(views, fields(camera)?.initial ?? camera, fields(camera)?.name, own);
  }
  for (const annotation of list(all.annotations, MOST_VIEWS)) {
    const it = fields(annotation);
    addView(views, fields(it?.camera)?.initial, it?.title, own);
  }
  const color = vector(fields(all.background)?.color, FARTHEST);
  const bounded = color?.map((c) => clamp(c, 0, 1)) as Vec3 | undefined;
  return {
    views, background: bounded ?? null, spots: list(all.annotations).some((each) => fields(each)?.position), animated: list(all.animTracks).length > 0,
    plays: all.startMode === "animTrack" || fields(all.camera)?.startAnim === "animTrack",
  };
}

function addView(views: View[], pose: unknown, name: unknown, own: boolean): void {
  const it = fields(pose);
  const [eye, to] = [vector(it?.position, FARTHEST), vector(it?.target, FARTHEST)];
  if (!it || !eye || !to || !(distance(eye, to) > 1e-9) || views.length >= MOST_VIEWS) return;
  const turn = (v: Vec3): Vec3 => (own ? v : [-v[0], -v[1], v[2]]);
  const fov = typeof it.fov === "number" && Number.isFinite(it.fov) ? it.fov : own ? 60 : 75;
  const view: View = { eye: turn(eye), to: turn(to), fov: clamp(fov, ...FOV_DEGREES), ...(own ? {} : LONGER) };
  views.push(typeof name === "string" && name.trim() ? { ...view, name: name.trim().slice(0, 80) } : view);
}
