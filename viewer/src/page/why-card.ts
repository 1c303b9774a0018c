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
import { text } from "./words.ts";

export interface Place {
  rig: Rig;
  frame: Frame;
}

/** Return what is known without a server. */
export function describePick(pick: Pick, header: Header | null): HTMLElement {
  const levels = header &&
    header.levels.length > 1 ? pick.levels.map((level) => header.levels[level]?.name ?? String(level)) : [];
  const [low, high] = levels;
  return make("section", {},
    make(
      "p", { class: "headline" }, pick.color ? swatch(pick.color) : null, text("why.gaussian", { id: pick.id }),
    ),
    make(
      "p", {},
      text("why.share", { count: pick.count }),
    ),
    facts([
      [text("why.weight"), formatShare(pick.weight)],
      [text("why.opacity"), formatShare(pick.opacity)],
      [text("why.distance"), formatLength(pick.depth, header?.metersPerUnit ?? 0)],
      [text("why.arrived"), text("why.number", { number: pick.slot + 1 })],
      levels.length ? [text("why.level"), low === high ? low : text("why.levels", { low, high })] : null,
      header?.terms ? [text("why.terms"), String(pick.terms)] : null,
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
    const says = seeing.length === 0 ? text("why.unseen")
      : `${text("why.seen", { count: seeing.length, of })} ${nearest(why)}`.trim();
    parts.push(make("section", {}, make("h3", {}, text("why.cells")), make("p", {}, says),
      cells ? drawMap(cells, seeing, pick.position, place.rig, place.frame) : null,
      cells ? make(
        "p", { class: "key" }, key("seeing", text("why.key.sees")), key("cell", text("why.key.not")),
        key("gaussian", text("why.key.gaussian")), key("eye", text("why.key.you")),
      ) : null));
  } else {
    parts.push(
      make("section", {}, make("p", {}, text("why.everything")))
    );
  }
  if (why.directions) {
    const { of, seen } = why.directions;
    parts.push(make("section", {}, make("h3", {}, text("why.directions")),
      make(
        "p", {},
        text("why.sphere", { count: seen.length, of, share: formatShare(seen.length / of) }),
      ),
      drawGlobe(seen, subtract(place.rig.eye, pick.position), place.frame.up)));
  }
  return parts;
}

function nearest(why: Why): string {
  const weight = why.cells?.seeing[0]?.weight;
  return weight ? text("why.nearest", { low: formatShare(weight[0]), high: formatShare(weight[1]) }) : "";
}

function key(look: string, meaning: string): HTMLElement {
  return make("span", {}, make("i", { class: `key-${look}` }), meaning);
}

function facts(rows: ([string, string] | null)[]): HTMLElement {
  const list = make("dl", { class: "facts" });
  for (const row of rows) if (row) list.append(make("div", {}, make("dt", {}, row[0]), make("dd", {}, row[1])));
  return list;
}
