// The ways to color a scene, and what each says.

import type { Header, Paint } from "../core/types.ts";
import type { Choice } from "./controls.ts";

interface PaintChoice extends Choice<Paint> {
  fits?(header: Header): boolean;
  marked?: true; // needs the marks of a scene with cells
}

export const PAINTS: readonly PaintChoice[] = [
  { value: "color", label: "Scene" },
  { value: "level", label: "Level", fits: (header) => header.levels.length > 1 },
  { value: "arrival", label: "Arrival" },
  { value: "opacity", label: "Opacity" },
  { value: "terms", label: "Terms", fits: (header) => header.terms > 0 },
  { value: "depth", label: "Depth" },
  { value: "visibility", label: "Visibility", marked: true },
  { value: "weight", label: "Weight", marked: true },
];

export const LEGENDS: Record<Paint, { text: string; low?: string; high?: string }> = {
  color: { text: "The scene in its own colors." },
  level: { text: "The quality level that each Gaussian last belongs to.", low: "low", high: "high" },
  arrival: { text: "The order in which the Gaussians have come.", low: "first", high: "last" },
  opacity: { text: "How much light each Gaussian takes.", low: "faint", high: "solid" },
  terms: { text: "How many terms of view-dependent color each Gaussian has.", low: "none", high: "many" },
  depth: { text: "The distance from your eye.", low: "far", high: "near" },
  visibility: { text: "From how many cells each Gaussian is seen.", low: "none", high: "all" },
  weight: { text: "The largest share of a pixel that a Gaussian has, from any cell.", low: "small", high: "large" },
};

const RAMP = ["#211c5c", "#2b5e9e", "#299e8f", "#a8cc4d", "#fce86b"]; // as the core draws them

/** Return the CSS color of a level in the picture of levels. */
export function levelColor(level: number, levels: number): string {
  const t = levels > 1 ? (4 * level) / (levels - 1) : 4;
  const low = Math.min(Math.floor(t), 3);
  return `color-mix(in srgb, ${RAMP[low + 1]} ${Math.round(100 * (t - low))}%, ${RAMP[low]})`;
}
