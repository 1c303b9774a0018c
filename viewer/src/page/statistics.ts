// Figures of the stream and the drawing, four times a second while they are shown.

import type { Header } from "../core/types.ts";
import { make, setText } from "./dom.ts";
import { formatBytes, formatCount, formatSeconds } from "./format.ts";
import type { Statistics } from "./viewer-like.ts";

const ROWS = {
  fps: "Frames a second", drawn: "Drawn", gaussians: "Gaussians", terms: "Terms", bytes: "Received", rate: "Rate",
  first: "First image",
} as const;

export class StatisticsCard {
  readonly element = make("section", { class: "statistics", "aria-label": "Statistics", hidden: true });
  readonly #values = new Map<string, HTMLElement>();

  constructor() {
    const list = make("dl");
    for (const [key, label] of Object.entries(ROWS)) {
      const value = make("dd", { "data-figure": key }, "–");
      this.#values.set(key, value);
      list.append(make("div", {}, make("dt", {}, label), value));
    }
    this.element.append(list);
  }

  show(now: Statistics, header: Header | null): void {
    const of = (count: number, all: number | undefined): string =>
      (all ? `${formatCount(count)} of ${formatCount(all)}` : formatCount(count));
    this.set("fps", now.fps > 0 ? (now.fps < 9.95 ? now.fps.toFixed(1) : String(Math.round(now.fps))) : "at rest");
    this.set("drawn", formatCount(now.drawn));
    this.set("gaussians", of(now.gaussians, header?.gaussians));
    this.set("terms", of(now.terms, header?.terms));
    this.set("bytes", formatBytes(now.bytes));
    this.set("rate", now.rate > 0 ? `${formatBytes(now.rate)}/s` : "–");
    this.set("first", now.firstImageSeconds === null ? "–" : formatSeconds(now.firstImageSeconds));
  }

  private set(key: keyof typeof ROWS, text: string): void {
    const value = this.#values.get(key);
    if (value) setText(value, text);
  }
}
