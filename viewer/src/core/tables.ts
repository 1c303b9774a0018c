// The tables that base colors and terms point into, and records decoded on the CPU: for tests, picking, and slow paths.
import { take } from "./bits.ts";
import { fromLog } from "./boxes.ts";
import type { ColorTables } from "./types.ts";

const KNEE = 0.5; // half the width of the interval in which base colors have even steps
const FLOOR = 0.1; // size of an intensity above which its steps grow with it
export const LEAST_LOG = -126 * 64, MOST_LOG = 128 * 64 - 1; // in 1/64 octave: what float32 holds as normal numbers
const LARGEST = 3.4028234663852886e38;

/** All tables of a scene. `base` has one for each component, hue of `hsl` among them; `scales` is [1] for `rgb`. */
export interface Tables {
  variant: "rgb" | "hsl";
  base: [Float32Array, Float32Array, Float32Array];
  scales: Float32Array;
  theta: Float32Array; // polar angles from +z
  phi: Float32Array; // azimuths from +x to +y
  decays: Float32Array;
  intensities: Float32Array; // 0 in the middle
  widths: number[]; // bits of function, polar angle, azimuth, decay and each intensity
  layout: RecordLayout;
}

/** Bits of a coordinate, a component of the quaternion and a log-scale, and the bit of a record at which they begin. */
export interface RecordLayout {
  position: number;
  rotation: number;
  scale: number;
  from: number;
  colorScale: boolean;
}

/** One Gaussian: geometry in scene units, base color in the variant's space. */
export interface Splat {
  mean: [number, number, number];
  quat: [number, number, number, number]; // wxyz, world from local
  scale: [number, number, number]; // standard deviations
  opacity: number;
  base: [number, number, number];
  colorScale: number;
}

/** One term: an SRBF around a center, and what it adds. */
export interface Term {
  function: number; // of hsl: 0 saturation, 1 lightness
  center: [number, number, number];
  decay: number;
  intensities: number[];
}

/** Return the layout of the records of a variant. */
export function recordLayout(variant: "rgb" | "hsl"): RecordLayout {
  return variant === "hsl"
    ? { position: 13, rotation: 8, scale: 8, from: 40, colorScale: true }
    : { position: 14, rotation: 9, scale: 9, from: 32, colorScale: false };
}

/** Return the bits of the parts of a term: function, polar angle, azimuth, decay, each intensity. */
export function termWidths(colors: ColorTables): number[] {
  const p = colors.precision, hsl = colors.variant === "hsl";
  return [hsl ? 1 : 0, p.center, p.center + 1, p.decay, ...Array<number>(hsl ? 1 : 3).fill(p.intensity)];
}

/** Return all tables that the numbers of a header define. */
export function tablesOf(colors: ColorTables): Tables {
  const p = colors.precision, hsl = colors.variant === "hsl", half = 1 << p.center;
  const component = (k: number) =>
    hsl && k === 0 ? circle(0, 1, 1 << p.base) : bend(colors.base[k][0], colors.base[k][1], 0.5, KNEE, p.base);
  return {
    variant: colors.variant,
    base: [component(0), component(1), component(2)],
    scales: hsl ? bend(colors.scales[0], colors.scales[1], 0, 1, p.scale) : Float32Array.of(1),
    theta: Float32Array.from({ length: half }, (_, k) => (k + 0.5) * (Math.PI / half)),
    phi: circle(-Math.PI, 2 * Math.PI, 2 * half),
    decays: geometric(colors.decays[0], colors.decays[1], p.decay),
    intensities: compand(colors.intensity, FLOOR, p.intensity),
    widths: termWidths(colors),
    layout: recordLayout(colors.variant),
  };
}

/** Return 2^bits values from low to high: evenly spaced within `knee` of the center, in even ratios outside. */
function bend(low: number, high: number, center: number, knee: number, bits: number): Float32Array {
  const place = (value: number) => {
    const x = value - center;
    return Math.abs(x) <= knee ? x : Math.sign(x) * knee * (1 + Math.log(Math.abs(x) / knee));
  };
  const count = 1 << bits, start = place(low), step = (place(high) - start) / (count - 1);
  return withEnds(count, low, high, (k) => {
    const x = start + k * step;
    return center + (Math.abs(x) <= knee ? x : Math.sign(x) * knee * Math.exp(Math.abs(x) / knee - 1));
  });
}

/** Return 2^bits values from low to high in even ratios. */
function geometric(low: number, high: number, bits: number): Float32Array {
  const count = 1 << bits, start = Math.log(low), step = (Math.log(high) - start) / (count - 1);
  return withEnds(count, low, high, (k) => Math.exp(start + k * step));
}

/** Return 2^bits - 1 values: entry i from the middle is floor (exp(k i) - 1), the last of them is the limit. */
function compand(limit: number, floor: number, bits: number): Float32Array {
  const half = (1 << (bits - 1)) - 1, rate = Math.log1p(limit / floor) / half;
  return withEnds(
    2 * half + 1, -limit, limit, (k) => Math.sign(k - half) * floor * Math.expm1(rate * Math.abs(k - half)),
  );
}

/** Return even steps from low, once around. */
function circle(low: number, turn: number, count: number): Float32Array {
  return Float32Array.from({ length: count }, (_, k) => low + k * (turn / count));
}

function withEnds(count: number, low: number, high: number, value: (k: number) => number): Float32Array {
  const table = Float32Array.from({ length: count }, (_, k) => Math.min(Math.max(value(k), low), high));
  table[0] = low;
  table[count - 1] = high;
  return table;
}

/** Write the center of record `i` to `means` at `i`; `chunks` is as in `Batch`, and `row` counts from its beginning. */
export function decodeMean(
  records: Uint32Array, i: number, chunks: Float32Array, row: number, layout: RecordLayout, means: Float32Array,
): void {
  const width = layout.position + layout.rotation + layout.scale;
  for (let k = 0; k < 3; k++) {
    const place = take(records, 128 * i + layout.from + k * width, layout.position), step = chunks[8 * row + 4 + k];
    const value = chunks[8 * row + k] + place * Math.abs(step);
    means[3 * i + k] = Math.min(Math.max(step < 0 ? fromLog(value) : value, -LARGEST), LARGEST);
  }
}

/** Return the Gaussian of record `i`; `chunks` is as in `Batch`, and `row` counts from its beginning. */
export function decodeRecord(
  records: Uint32Array, i: number, chunks: Float32Array, row: number, tables: Tables,
): Splat {
  const { layout, base, scales } = tables;
  const width = layout.position + layout.rotation + layout.scale, half = (1 << (layout.rotation - 1)) - 1;
  const mean = new Float32Array(3), scale: number[] = [], v: number[] = [];
  decodeMean(records.subarray(4 * i, 4 * i + 4), 0, chunks, row, layout, mean);
  for (let k = 0; k < 3; k++) {
    const bit = 128 * i + layout.from + k * width + layout.position;
    v.push((take(records, bit, layout.rotation) - half) * (Math.SQRT1_2 / half));
    const level = chunks[8 * row + 3] + take(records, bit + layout.rotation, layout.scale) * chunks[8 * row + 7];
    scale.push(Math.fround(2 ** (Math.min(Math.max(level, LEAST_LOG), MOST_LOG) / 64)));
  }
  const w = Math.sqrt(Math.max(0, 1 - v[0] * v[0] - v[1] * v[1] - v[2] * v[2]));
  const place = (k: number, table: Float32Array) => table[
    Math.min(take(records, 128 * i + 8 * k, 8), table.length - 1)
  ];
  return {
    mean: [mean[0], mean[1], mean[2]],
    quat: [w, v[0], v[1], v[2]],
    scale: [scale[0], scale[1], scale[2]],
    opacity: take(records, 128 * i, 8) / 255,
    base: [place(1, base[0]), place(2, base[1]), place(3, base[2])],
    colorScale: layout.colorScale ? place(4, scales) : 1,
  };
}

/** Return term `i`; `terms` is as in `Batch`. */
export function decodeTerm(terms: Uint32Array, i: number, tables: Tables): Term {
  let bit = 64 * i;
  const places = tables.widths.map((width) => {
    const place = width === 0 ? 0 : take(terms, bit, width);
    bit += width;
    return place;
  });
  const theta = tables.theta[places[1]], phi = tables.phi[places[2]], last = tables.intensities.length - 1;
  return {
    function: places[0],
    center: [Math.sin(theta) * Math.cos(phi), Math.sin(theta) * Math.sin(phi), Math.cos(theta)],
    decay: tables.decays[places[3]],
    intensities: places.slice(4).map((place) => tables.intensities[Math.min(place, last)]),
  };
}

/** Return the RGB (>= 0) that an eye sees of a Gaussian with these terms. */
export function colorSeen(
  splat: Splat, terms: Term[], eye: [number, number, number], variant: "rgb" | "hsl",
): [number, number, number] {
  const away = splat.mean.map((value, k) => value - eye[k]), length = Math.hypot(...away);
  const x = length > 0 ? away.map((value) => value / length) : [0, 0, 1];
  const color = [...splat.base];
  for (const term of terms) {
    const lobe = Math.exp(term.decay * (x[0] * term.center[0] + x[1] * term.center[1] + x[2] * term.center[2] - 1));
    if (variant === "hsl") color[1 + term.function] += lobe * term.intensities[0] * splat.base[1 + term.function];
    else for (let k = 0; k < 3; k++) color[k] += lobe * term.intensities[k];
  }
  const rgb = variant === "hsl" ? rgbOfHsl(color[0], clamp(color[1]), clamp(color[2])) : color;
  const factor = variant === "hsl" ? splat.colorScale : 1;
  return [Math.max(rgb[0], 0) * factor, Math.max(rgb[1], 0) * factor, Math.max(rgb[2], 0) * factor];
}

function clamp(value: number): number {
  return Math.min(Math.max(value, 0), 1);
}

/** Return RGB of hue in turns, saturation and lightness in [0, 1]. */
function rgbOfHsl(hue: number, saturation: number, lightness: number): [number, number, number] {
  const chroma = saturation * Math.min(lightness, 1 - lightness);
  const channel = (shift: number) => {
    const k = shift + 12 * hue, turn = k - 12 * Math.floor(k / 12);
    return lightness - chroma * Math.max(-1, Math.min(turn - 3, 9 - turn, 1));
  };
  return [channel(0), channel(8), channel(4)];
}
