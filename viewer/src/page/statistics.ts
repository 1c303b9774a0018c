// Figures of the stream and the drawing, four times a second while they are shown.

import type { Header } from "../core/types.ts";
import { make, setText } from "./dom.ts";
import { formatBytes, formatCount, formatRate, formatSeconds } from "./format.ts";
import type { Statistics } from "./viewer-like.ts";
import { text } from "./words.ts";

const ROWS = ["fps", "drawn", "gaussians", "terms", "bytes", "rate", "first"] as const;

export class StatisticsCard {
  readonly element = make("section", { class: "statistics", "aria-label": text("statistics.title"), hidden: true });
  readonly #values = new Map<string, HTMLElement>();

  constructor() {
    const list = make("dl");
    for (const key of ROWS) {
      const value = make("dd", { "data-figure": key }, text("number.none"));
      this.#values.set(key, value);
      list.append(make("div", {}, make("dt", {}, text(`statistics.${key}`)), value));
    }
    this.element.append(list);
  }

  show(now: Statistics, header: Header | null): void {
    const of = (count: number, all: number | undefined): string =>
      (all ? text("count.of", { count: formatCount(count), all: formatCount(all) }) : formatCount(count));
    this.set("fps", now.fps > 0 ? formatRate(now.fps) : text("statistics.rest"));
    this.set("drawn", formatCount(now.drawn));
    this.set("gaussians", of(now.gaussians, header?.gaussians));
    this.set("terms", of(now.terms, header?.terms));
    this.set("bytes", formatBytes(now.bytes));
    this.set("rate", now.rate > 0 ? text("number.rate", { bytes: formatBytes(now.rate) }) : text("number.none"));
    this.set("first", now.firstImageSeconds === null ? text("number.none") : formatSeconds(now.firstImageSeconds));
  }

  private set(key: (typeof ROWS)[number], figure: string): void {
    const value = this.#values.get(key);
    if (value) setText(value, figure);
  }
}
