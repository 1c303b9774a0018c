// The answer to a click: which Gaussian makes this pixel, why it is here, and from where it is seen.

import type { Header } from "../core/types.ts";
import { make } from "./dom.ts";
import type { Cells, Why } from "./facts.ts";
import { formatLength, formatShare } from "./format.ts";
import { drawGlobe } from "./globe.ts";
import { drawMap } from "./map.ts";
import type { Rig } from "./rig.ts";
import { subtract } from "./vector.ts";
import type { Frame } from "./vector.ts";
import type { Pick } from "./viewer-like.ts";

export interface Place {
  rig: Rig;
  frame: Frame;
}

/** Return what is known without a server. */
export function describePick(pick: Pick, header: Header | null): HTMLElement {
  const levels = header &&
    header.levels.length > 1 ? pick.levels.map((level) => header.levels[level]?.name ?? String(level)) : [];
  return make("section", {},
    make(
      "p", { class: "headline" }, pick.color ? swatch(pick.color) : null, `Gaussian ${pick.id.toLocaleString("en-US")}`,
    ),
    make(
      "p", {},
      pick.count > 1 ? `Of the ${pick.count} Gaussians that reach this pixel, it gives the largest share.`
        : "It alone makes this pixel.",
    ),
    facts([
      ["Share of this pixel", formatShare(pick.weight)],
      ["Opacity", formatShare(pick.opacity)],
      ["Distance", formatLength(pick.depth, header?.metersPerUnit ?? 0)],
      ["Arrived as", `number ${(pick.slot + 1).toLocaleString("en-US")}`],
      levels.length ? ["Level", [...new Set(levels)].join(" to ")] : null,
      header?.terms ? ["Terms of its color", String(pick.terms)] : null,
    ]),
  );
}

function swatch(color: readonly number[]): HTMLElement {
  const shown = make("i", { class: "swatch" });
  shown.style.setProperty(
    "background", `rgb(${color.map((c) => Math.round(255 * Math.min(Math.max(c, 0), 1))).join(" ")})`,
  );
  return shown;
}

/** Return what the server knows: why it was sent, and from where it is seen. */
export function describeWhy(why: Why, pick: Pick, cells: Cells | null, place: Place): HTMLElement[] {
  const parts: HTMLElement[] = [];
  if (why.cells) {
    const { of, seeing } = why.cells;
    const text = seeing.length === 0 ? "No cell sees it from inside; it was sent for what lies between."
      : `It is here because ${seeing.length} of ${of} cells see it${nearest(why)}.`;
    parts.push(make("section", {}, make("h3", {}, "Cells that see it"), make("p", {}, text),
      cells ? drawMap(cells, seeing, pick.position, place.rig, place.frame) : null,
      cells ? make(
        "p", { class: "key" }, key("seeing", "sees it"), key("cell", "does not"), key("gaussian", "the Gaussian"),
        key("eye", "you"),
      ) : null));
  } else {
    parts.push(
      make("section", {}, make("p", {}, "This scene has no visible sets: all of it is sent, the nearest first."))
    );
  }
  if (why.directions) {
    const { of, seen } = why.directions;
    parts.push(make("section", {}, make("h3", {}, "Directions from which it is seen"),
      make(
        "p", {},
        `${seen.length} of ${of} directions, ${formatShare(seen.length / of)} of the sphere around it. ` +
          "The globe faces you.",
      ),
      drawGlobe(seen, subtract(place.rig.eye, pick.position), place.frame.up)));
  }
  return parts;
}

function nearest(why: Why): string {
  const weight = why.cells?.seeing[0]?.weight;
  return weight ? `; the nearest gives it ${formatShare(weight[0])} to ${formatShare(weight[1])} of a pixel` : "";
}

function key(look: string, text: string): HTMLElement {
  return make("span", {}, make("i", { class: `key-${look}` }), text);
}

function facts(rows: ([string, string] | null)[]): HTMLElement {
  const list = make("dl", { class: "facts" });
  for (const row of rows) if (row) list.append(make("div", {}, make("dt", {}, row[0]), make("dd", {}, row[1])));
  return list;
}
