// Numbers as people read them, in the language of the page.

import { number, text } from "./words.ts";

const PLAIN = { useGrouping: false };

/** Return a count in three digits: 950, 12.4 k, 1.50 M. */
export function formatCount(count: number): string {
  if (!Number.isFinite(count)) return text("number.none");
  for (const [size, unit] of [[1e9, "G"], [1e6, "M"], [1e3, "k"]] as const) {
    if (Math.abs(count) >= 0.9995 * size) return `${threeDigits(count / size)} ${unit}`;
  }
  return number(Math.round(count), PLAIN);
}

/** Return a count of Gaussians: 12.4 k Gaussians. */
export function formatGaussians(count: number): string {
  const one = count === 1 ? count : 2; // the form of a shortened count is that of many
  return text("count.gaussians", { count: one }).replace(number(one), formatCount(count));
}

/** Return a rate, with a decimal below ten. */
export function formatRate(rate: number): string {
  return number(rate, digitsOf(rate < 9.95 ? 1 : 0));
}

/** Return bytes with a unit of 1000: 7.20 MB. */
export function formatBytes(bytes: number): string {
  if (!Number.isFinite(bytes)) return text("number.none");
  for (const [size, unit] of [[1e9, "GB"], [1e6, "MB"], [1e3, "kB"]] as const) {
    if (bytes >= 0.9995 * size) return `${threeDigits(bytes / size)} ${unit}`;
  }
  return `${number(Math.round(bytes), PLAIN)} B`;
}

/** Return seconds: 0.43 s, 12 s, 3 min. */
export function formatSeconds(seconds: number): string {
  if (!Number.isFinite(seconds)) return text("number.none");
  if (seconds < 100) return `${threeDigits(seconds)} s`;
  return `${number(Math.round(seconds / 60))} min`;
}

/** Return a length, in meters where the scene says how long one is. */
export function formatLength(units: number, metersPerUnit: number): string {
  if (metersPerUnit > 0) return `${threeDigits(units * metersPerUnit)} m`;
  return text("number.units", { length: threeDigits(units) });
}

/** Return a share as percent: 3.2%, 45%, under 0.1%. */
export function formatShare(share: number): string {
  const percent = (value: number, digits: number): string => number(value, { style: "percent", ...digitsOf(digits) });
  if (share > 0 && share < 0.001) return text("number.tiny", { share: percent(0.001, 1) });
  return percent(share, share < 0.1 ? 1 : 0);
}

/** Return a color such as #20242c, each channel from 0 to 1; null for any other text. */
export function colorOf(text: string | null): [number, number, number] | null {
  if (!/^#[0-9a-f]{6}$/i.test(text ?? "")) return null;
  const [red, green, blue] = [1, 3, 5].map((at) => parseInt(text!.slice(at, at + 2), 16) / 255);
  return [red, green, blue];
}

function threeDigits(x: number): string {
  const size = Math.abs(x);
  return number(x, { useGrouping: false, ...digitsOf(size >= 99.95 ? 0 : size >= 9.995 ? 1 : 2) });
}

function digitsOf(digits: number): Intl.NumberFormatOptions {
  return { minimumFractionDigits: digits, maximumFractionDigits: digits };
}
