// The tables of colors as the GPU reads them: one texture of pairs, 1024 to a row, and where each table begins in it.
import { tablesOf } from "./tables.ts";
import type { ColorLayout } from "./shaders.ts";
import type { HarmonicTables, Header, Paint } from "./types.ts";

const ROW = 1024;

/** The number of each paint in the program that finds colors. */
export const PAINTS: Record<Paint, number> = {
  color: 0, opacity: 1, level: 2, arrival: 3, terms: 4, depth: 5, visibility: 6, weight: 6,
};

export interface PackedTables {
  layout: ColorLayout;
  texels: Float32Array; // (2 * 1024 * rows)
  rows: number;
}

/** Return all tables of a scene; angles stand as sine and cosine. */
export function packTables(header: Header): PackedTables {
  const tables = tablesOf(header.colors), pairs: number[] = [];
  const put = (values: Float32Array, angle = false) => {
    const start = pairs.length / 2;
    for (const value of values) pairs.push(angle ? Math.sin(value) : value, angle ? Math.cos(value) : 0);
    return start;
  };
  const layout: ColorLayout = {
    hsl: header.colors.variant === "hsl",
    base: [put(tables.base[0]), put(tables.base[1]), put(tables.base[2])],
    most: tables.base[1].length - 1,
    scales: put(tables.scales),
    mostScale: tables.scales.length - 1,
    theta: put(tables.theta, true),
    phi: put(tables.phi, true),
    decays: put(tables.decays),
    intensities: put(tables.intensities),
    mostIntensity: tables.intensities.length - 1,
    widths: tables.widths,
    degree: header.harmonics?.degree ?? 0,
  };
  const rows = Math.ceil(pairs.length / 2 / ROW), texels = new Float32Array(2 * ROW * rows);
  texels.set(pairs);
  return { layout, texels, rows };
}

/** Texels of 16 bytes that a set of harmonics takes. */
export function harmonicTexels(tables: HarmonicTables): number {
  return Math.ceil(harmonicBytes(tables) / 16);
}

/** Bytes of a set of harmonics. */
export function harmonicBytes(tables: HarmonicTables): number {
  return 3 * ((tables.degree + 1) ** 2 - 1);
}

/**
 * Return sets of 3 K bytes each as whole texels, with the upper bit of each byte turned: so a texel that was never
 * written, all zeros, stands for no change of color.
 */
export function packSets(bytes: Uint8Array, tables: HarmonicTables): Uint32Array {
  const own = harmonicBytes(tables), padded = 16 * harmonicTexels(tables), count = bytes.length / own;
  const out = new Uint8Array(padded * count);
  for (let i = 0, from = 0, to = 0; i < count; i++, to += padded - own) {
    for (const end = from + own; from < end; from++, to++) out[to] = bytes[from] ^ 128;
  }
  return new Uint32Array(out.buffer);
}

/** Return what byte 0 means and what a step of a byte adds, for each of `count` coefficients and R, G, B. */
export function harmonicRanges(tables: HarmonicTables): { lows: Float32Array; spans: Float32Array } {
  const count = (tables.degree + 1) ** 2 - 1;
  const lows = new Float32Array(3 * count), spans = new Float32Array(3 * count);
  for (let k = 0; k < count; k++) {
    for (let c = 0; c < 3; c++) {
      const i = rangeOf(tables.low.length, count, k, c);
      lows[3 * k + c] = tables.low[i];
      spans[3 * k + c] = (tables.high[i] - tables.low[i]) / 255;
    }
  }
  return { lows, spans };
}

/** Ranges may be one for all, or one for each band, coefficient, or coefficient and channel. */
function rangeOf(ranges: number, count: number, k: number, channel: number): number {
  if (ranges === 3 * count) return 3 * k + channel;
  if (ranges === count) return k;
  return ranges === 1 ? 0 : Math.min(Math.floor(Math.sqrt(k + 1)) - 1, ranges - 1);
}
