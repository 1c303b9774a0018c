// The texts of the page in the visitor's language. Each language is one file, `words/*.json`: English is part of the page,
// any other is loaded where it is used. `{name}` stands for a value; a text that depends on a count has a form for each
// class of numbers (`Intl.PluralRules`).

import { meta } from "./dom.ts";
import { offer, part } from "./parts.ts";
import english from "./words/en.json" with { type: "json" };

type Forms = string | Partial<Record<Intl.LDMLPluralRule, string>>;
export type Key = keyof typeof english;
export type Words = Record<string, Forms>;
export type Values = Record<string, string | number>;

/** Languages with a file of their own, beside English. */
export const OTHERS: readonly string[] = ["de"];

let words: Words = english;
export let language = "en";

/** Return a text with its values; a number `count` chooses its form. */
export function text(key: Key, values: Values = {}): string {
  const forms = words[key] ?? english[key], { count } = values;
  const form = typeof forms === "string" ? forms
    : forms[typeof count === "number" ? new Intl.PluralRules(language).select(count) : "other"] ?? forms.other ?? "";
  return form.replace(/\{(\w+)\}/g, (_, name: string) => {
    const value = values[name];
    return typeof value === "number" ? number(value) : value ?? "";
  });
}

/** Return a number as the language writes it. */
export function number(value: number, options: Intl.NumberFormatOptions = {}): string {
  return new Intl.NumberFormat(language, options).format(value);
}

/**
 * Return the language of a visit: the first one known of `?lang=`, what whoever wrote the page chose, and the browser's
 * list; else English.
 */
export function chooseLanguage(asked: readonly (string | null | undefined)[]): string {
  for (const each of asked) {
    const known = ["en", ...OTHERS].find((name) => each?.toLowerCase().split(/[-_]/)[0] === name);
    if (known) return known;
  }
  return "en";
}

/** Speak the language of this visit from now on; English where its file does not come. */
export async function speakLanguage(): Promise<void> {
  const chosen = chooseLanguage([
    new URLSearchParams(location.search).get("lang"), meta("language"), ...navigator.languages,
  ]);
  if (chosen !== "en") {
    try {
      useWords(chosen, await part(`words-${chosen}`) as Words);
    } catch {
      // its file is missing: English is better than nothing
    }
  }
  document.documentElement.lang = language;
}

/** Take the texts of another language. */
export function useWords(name: string, all: Words): void {
  [language, words] = [name, all];
}

offer("text", text);
