// The ways to color a scene, and what each says.

import type { Header, Paint } from "../core/types.ts";
import type { Choice } from "./controls.ts";
import { text } from "./words.ts";

export interface PaintChoice extends Choice<Paint> {
  fits?(header: Header): boolean;
  marked?: true; // needs the marks of a scene with cells
}

const ALL: readonly Omit<PaintChoice, "label">[] = [
  { value: "color" },
  { value: "level", fits: (header) => header.levels.length > 1 },
  { value: "arrival" },
  { value: "opacity" },
  { value: "terms", fits: (header) => header.terms > 0 },
  { value: "depth" },
  { value: "visibility", marked: true },
  { value: "weight", marked: true },
];

/** Return the ways to color a scene; `celled`: there are marks to ask for. */
export function paintsOf(header: Header, celled: boolean): PaintChoice[] {
  return ALL.filter(({ marked, fits }) => (marked ? celled : !fits || fits(header)))
    .map((paint) => ({ ...paint, label: text(`paint.${paint.value}`) }));
}

/** Whether a way to color needs the marks of a scene with cells. */
export const isMarked = (paint: Paint): boolean => ALL.some(({ value, marked }) => value === paint && marked);

/** Return what a way to color shows, and what its lowest and its highest color mean. */
export function legendOf(paint: Paint): { says: string; low?: string; high?: string } {
  const says = text(`paint.${paint}.text`);
  return paint === "color" ? { says } : { says, low: text(`paint.${paint}.low`), high: text(`paint.${paint}.high`) };
}

const RAMP = ["#211c5c", "#2b5e9e", "#299e8f", "#a8cc4d", "#fce86b"]; // as the core draws them

/** Return the CSS color of a level in the picture of levels. */
export function levelColor(level: number, levels: number): string {
  const t = levels > 1 ? (4 * level) / (levels - 1) : 4;
  const low = Math.min(Math.floor(t), 3);
  return `color-mix(in srgb, ${RAMP[low + 1]} ${Math.round(100 * (t - low))}%, ${RAMP[low]})`;
}
