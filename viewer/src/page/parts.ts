// Loads scripts that only some pages need. A page in one file holds them beside its own, and cannot import them.

import type { Player, Stage } from "./stage.ts";
import type { Key, Values, Words } from "./words.ts";

/** What each script offers. */
interface Parts {
  tour(stage: Stage, settings: unknown): Player;
  hotspots(stage: Stage, settings: unknown): HTMLElement;
  author(stage: Stage): HTMLElement;
  embed(stage: Stage, embedders: readonly string[]): void;
  text(key: Key, values?: Values): string; // of the page itself
  [words: `words-${string}`]: Words; // texts of a language
}

type Held = { gsvisParts?: Partial<Parts> };

/** Make a part known to the page; not by an export alone, since a page in one file has no imports. */
export function offer<K extends keyof Parts>(name: K, part: Parts[K]): void {
  ((globalThis as Held).gsvisParts ??= {})[name] = part;
}

/** Return a part, loaded where it is not here yet. */
export async function part<K extends keyof Parts>(name: K): Promise<Parts[K]> {
  const held = globalThis as Held;
  if (!held.gsvisParts?.[name]) await import(new URL(`${name}.js`, import.meta.url).href);
  return held.gsvisParts![name] as Parts[K];
}

/** Return a text of the page, in scripts of their own: they hold no texts. */
export function textOfPage(key: Key, values?: Values): string {
  return (globalThis as Held).gsvisParts!.text!(key, values);
}
