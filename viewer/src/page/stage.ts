// What scripts that a page loads when it needs them see of it: hotspots, authoring, and the voice of a page in a frame.
// Each is a file of its own, so these names are the ones that `build.mjs` does not shorten.

import type { Permit } from "./address.ts";
import type { View } from "./hash.ts";
import type { Mode } from "./navigator.ts";
import type { Quality } from "./quality.ts";
import type { Loops } from "./tour.ts";
import type { Vec3 } from "./vector.ts";
import type { Pick } from "./viewer-like.ts";

/** Where a page stands: its view, the size of its picture in CSS pixels, and how its scene fares. */
export interface Look {
  view: View; // `fov` from the lower to the upper border
  up: Vec3;
  mode: Mode;
  width: number;
  height: number;
  state: string; // "connecting", "streaming", "complete", "waiting" or "failed"
  message: string; // what went wrong
  gaussians: number; // on the graphics card
  of: number; // in the scene; 0 until that is known
  drawn: boolean; // a first picture was shown
  led: boolean; // an animation leads the view
}

/** Leads the view along the animation of the settings. */
export interface Player {
  readonly bar: HTMLElement; // its controls
  readonly playing: boolean;
  readonly seconds: number; // that are shown
  readonly duration: number; // seconds, one way
  readonly loops: Loops;
  /** Go on from where it is, from the start where it has ended. */
  play(): void;
  pause(): void;
  /** Go to a second; it plays on if it plays. */
  seek(seconds: number): void;
}

export interface Stage {
  name: string; // of the scene
  visitor: boolean; // nothing that is for engineers
  permits: Permit; // which addresses the page may open
  look(): Look;
  /** Fly to a view; jump there where `now`. */
  go(view: View, now?: boolean): void;
  turn(mode: Mode): void;
  /** Let a track lead the view, by the seconds since its last one, until it ends or somebody moves; null ends it. */
  lead(track: ((seconds: number) => View | null) | null): void;
  /** Return what plays the animation; null without one. */
  player(): Player | null;
  find(x: number, y: number): Promise<Pick | null>;
  picture(): Promise<Blob>;
  /** Draw with a preset, and at most so many Gaussians where that is not null. */
  refine(quality: Quality, budget: number | null): void;
  /** Return the settings of the page as they were read. */
  settings(): unknown;
  /** Show other settings. */
  apply(settings: unknown): Promise<void>;
  /** Call with each click on the picture; one that is taken (true) does nothing else. */
  clicks(take: (x: number, y: number) => boolean): void;
  say(line: string): void;
  /** Call back whenever the view has changed or rests. */
  follow(each: (resting: boolean) => void): void;
}
