// How much the page draws: a preset, or as much as this device draws smoothly. At rest an automatic choice draws all.

import type { ViewerLike } from "./viewer-like.ts";

export const QUALITIES = ["auto", "low", "medium", "high"] as const;
export type Quality = (typeof QUALITIES)[number];

/** Most Gaussians in a picture, and most pixels for each CSS pixel. */
export interface Limits {
  budget: number;
  ratio: number;
}

const ALL: Limits = { budget: Infinity, ratio: Infinity };
const PRESETS: Record<Quality, Limits> = {
  auto: ALL, low: { budget: 250_000, ratio: 0.75 }, medium: { budget: 500_000, ratio: 1 }, high: ALL,
};
// What an automatic choice tries while the view moves, one after the other.
const STEPS: readonly Limits[] = [
  ALL, { budget: 1_000_000, ratio: 1.5 }, PRESETS.medium, { budget: 250_000, ratio: 1 }, { budget: 125_000, ratio: 0.75 },
];
const SLOW_MS = 50, FAST_MS = 20; // between two pictures
const SLOW_FRAMES = 6, FAST_FRAMES = 60; // until it counts
const PAUSE_MS = 1000; // between pictures that do not follow each other

/** Return the quality that a text names, null for any other text. */
export function qualityOf(text: unknown): Quality | null {
  return QUALITIES.find((each) => each === text) ?? null;
}

/** Return the budget that a text or a number means: Gaussians, at least one; null for any other. */
export function budgetOf(value: unknown): number | null {
  const budget = Math.floor(Number(value ?? NaN));
  return budget >= 1 ? budget : null;
}

export class QualityChoice {
  #viewer: Pick<ViewerLike, "budget" | "maxPixelRatio"> | null = null;
  #step = 0;
  #slowest = -1; // step at which pictures came too slowly
  #last = -Infinity; // time of the last picture
  #times: number[] = [];
  #moves = false;

  /** `chosen` is a preset; `budget`, where it is not null, bounds it. */
  constructor(public chosen: Quality, public budget: number | null) {}

  /** What holds now. */
  get limits(): Limits {
    const { budget, ratio } = this.chosen === "auto" && this.#moves ? STEPS[this.#step] : PRESETS[this.chosen];
    return { budget: Math.min(budget, this.budget ?? Infinity), ratio };
  }

  /** Draw with this viewer from now on. */
  use(viewer: Pick<ViewerLike, "budget" | "maxPixelRatio">): void {
    this.#viewer = viewer;
    this.#apply();
  }

  choose(chosen: Quality, budget = this.budget): void {
    [this.chosen, this.budget] = [chosen, budget];
    this.#apply();
  }

  /** Say whether the view moves. */
  move(moves: boolean): void {
    if (this.#moves === moves) return;
    this.#moves = moves;
    this.#times = [];
    this.#last = -Infinity;
    this.#apply();
  }

  /** Say that a picture was drawn at a time, in milliseconds. */
  drawn(now: number): void {
    const passed = now - this.#last;
    this.#last = now;
    if (!this.#moves || this.chosen !== "auto" || passed > PAUSE_MS) return;
    this.#times.push(passed);
    if (this.#times.length >= SLOW_FRAMES && median(this.#times.slice(-SLOW_FRAMES)) > SLOW_MS) {
      this.#slowest = this.#step;
      this.#go(this.#step + 1);
    } else if (this.#times.length >= FAST_FRAMES) {
      const isFast = median(this.#times) < FAST_MS && this.#step - 1 > this.#slowest;
      this.#go(isFast ? this.#step - 1 : this.#step);
    }
  }

  #go(step: number): void {
    this.#step = Math.min(Math.max(step, 0), STEPS.length - 1);
    this.#times = [];
    this.#apply();
  }

  #apply(): void {
    if (!this.#viewer) return;
    const { budget, ratio } = this.limits;
    [this.#viewer.budget, this.#viewer.maxPixelRatio] = [budget, ratio];
  }
}

function median(times: readonly number[]): number {
  return [...times].sort((a, b) => a - b)[times.length >> 1];
}
