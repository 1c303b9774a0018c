// Numbers as people read them.

/** Return a count in three digits: 950, 12.4 k, 1.50 M. */
export function formatCount(count: number): string {
  if (!Number.isFinite(count)) return "–";
  for (const [size, unit] of [[1e9, "G"], [1e6, "M"], [1e3, "k"]] as const) {
    if (Math.abs(count) >= 0.9995 * size) return `${threeDigits(count / size)} ${unit}`;
  }
  return String(Math.round(count));
}

/** Return bytes with a unit of 1000: 7.20 MB. */
export function formatBytes(bytes: number): string {
  if (!Number.isFinite(bytes)) return "–";
  for (const [size, unit] of [[1e9, "GB"], [1e6, "MB"], [1e3, "kB"]] as const) {
    if (bytes >= 0.9995 * size) return `${threeDigits(bytes / size)} ${unit}`;
  }
  return `${Math.round(bytes)} B`;
}

/** Return seconds: 0.43 s, 12 s, 3 min. */
export function formatSeconds(seconds: number): string {
  if (!Number.isFinite(seconds)) return "–";
  if (seconds < 100) return `${threeDigits(seconds)} s`;
  return `${Math.round(seconds / 60)} min`;
}

/** Return a length, in meters where the scene says how long one is. */
export function formatLength(units: number, metersPerUnit: number): string {
  return metersPerUnit > 0 ? `${threeDigits(units * metersPerUnit)} m` : `${threeDigits(units)} units`;
}

/** Return a share as percent: 3.2%, 45%, under 0.1%. */
export function formatShare(share: number): string {
  const percent = 100 * share;
  if (percent > 0 && percent < 0.1) return "under 0.1%";
  return `${percent < 10 ? percent.toFixed(1) : Math.round(percent)}%`;
}

/** Return a color such as #20242c, each channel from 0 to 1; null for any other text. */
export function colorOf(text: string | null): [number, number, number] | null {
  if (!/^#[0-9a-f]{6}$/i.test(text ?? "")) return null;
  const [red, green, blue] = [1, 3, 5].map((at) => parseInt(text!.slice(at, at + 2), 16) / 255);
  return [red, green, blue];
}

function threeDigits(x: number): string {
  const size = Math.abs(x);
  return x.toFixed(size >= 99.95 ? 0 : size >= 9.995 ? 1 : 2);
}
