// The texts of the page: every language says the same things, the sources hold none, numbers and plurals follow.
import assert from "node:assert/strict";
import { readdirSync, readFileSync } from "node:fs";
import { join } from "node:path";
import { test } from "node:test";
import { formatCount, formatGaussians, formatLength, formatShare } from "../src/page/format.ts";
import { chooseLanguage, OTHERS, text, useWords } from "../src/page/words.ts";
import type { Words } from "../src/page/words.ts";

const PAGE = join(process.cwd(), "src/page"), WORDS = join(PAGE, "words");
const read = (name: string): Words => JSON.parse(readFileSync(join(WORDS, `${name}.json`), "utf8")) as Words;
const formsOf = (forms: Words[string]): string[] => (typeof forms === "string" ? [forms] : Object.values(forms));
const placesOf = (form: string): string => [...form.matchAll(/\{\w+\}/g)].map(([place]) => place).sort().join();
const sourcesOf = (folder: string): string[] => readdirSync(folder).filter((name) => name.endsWith(".ts"))
  .map((name) => join(folder, name));

test("every language has the same texts with the same values, and a form for each class of its numbers", () => {
  const english = read("en");
  assert.deepEqual(readdirSync(WORDS).sort(), ["en", ...OTHERS].map((name) => `${name}.json`).sort());
  for (const name of ["en", ...OTHERS]) {
    const words = read(name), { pluralCategories } = new Intl.PluralRules(name).resolvedOptions();
    assert.deepEqual(Object.keys(words).sort(), Object.keys(english).sort(), name);
    for (const [key, forms] of Object.entries(words)) {
      assert.match(key, /^\w+\./); // names without a dot might be shortened as properties
      assert.equal(typeof forms, typeof english[key], key);
      if (typeof forms === "object") assert.deepEqual(Object.keys(forms).sort(), [...pluralCategories].sort(), key);
      const most = (all: Words): string => placesOf(formsOf(all[key]).at(-1)!);
      assert.equal(most(words), most(english), `${name}: ${key}`);
    }
  }
});

test("every text is used, and its key is in the source as it is, or with a value for a part of it", () => {
  const sources = [...sourcesOf(PAGE), ...["view", "list"].map((name) => join(PAGE, `${name}.html`))]
    .map((path) => readFileSync(path, "utf8")).join("\n");
  const patterns = [...sources.matchAll(/text(?:OfPage)?\(`([^`]*)`\)/g)].map(([, template]) =>
    new RegExp(`^${template.replaceAll(/\$\{[^}]*\}/g, "\\w+").replaceAll(".", "\\.")}$`));
  for (const key of Object.keys(read("en"))) {
    assert.ok(
      sources.includes(`"${key}"`) || sources.includes(`%${key}%`) || patterns.some((one) => one.test(key)), key,
    );
  }
});

/** Return the literals of a source, each with what stands before it; without comments and patterns. */
function literalsOf(source: string): [string, string][] {
  const found: [string, string][] = [];
  const token = /\/\/.*|\/\*[^]*?\*\/|(?<=[(,=:!&|?]\s*)\/(?:[^/\\\n[]|\\.|\[(?:[^\]\\]|\\.)*\])+\/\w*|"((?:[^"\\\n]|\\.)*)"|'((?:[^'\\\n]|\\.)*)'|`((?:[^`\\]|\\.)*)`/g;
  for (const match of source.matchAll(token)) {
    const literal = match[1] ?? match[2] ?? match[3];
    if (literal === undefined) continue;
    for (const part of literal.split(/\$\{[^}]*\}/)) found.push([part, source.slice(0, match.index).trimEnd()]);
  }
  return found;
}

/** Return the texts of a source that a person would read: two words, or one with a capital letter. */
function proseOf(source: string): string[] {
  const forPrograms = /(\bnew (Patch)?Error|querySelector(All)?(<\w+>)?|matches|closest|matchMedia|getContext|viewBox:|allow:)\(?$|\b(from|import|type)$/;
  return literalsOf(source).filter(([literal, before]) =>
    /[A-Za-z]{2,} [A-Za-z]{2,}|^[A-Z][a-z]{2,}/.test(literal.trim()) && !forPrograms.test(before)).map(([literal]) => literal);
}

const ALLOWED = new Set(["Escape", "Enter", "Key", "noopener noreferrer", "color-mix(in srgb, "]); // keys, HTML, CSS

test("no source of the page holds a text that it shows", () => {
  assert.deepEqual(proseOf('a.title = "Close"; b(`${n} more views`); // "Not this"\nnew Error("nor this")'), ["Close", " more views"]);
  for (const name of ["view.html", "list.html"]) {
    const shown = readFileSync(join(PAGE, name), "utf8").replaceAll(/<[^>]*>|%[\w.]+%|\s+/g, " ").trim();
    assert.match(shown, /^· gsvis$/, name);
  }
  const found = sourcesOf(PAGE).flatMap((path) => proseOf(readFileSync(path, "utf8")).map((line) => `${path.split("/").pop()}: ${line}`));
  assert.deepEqual(found.filter((line) => !ALLOWED.has(line.replace(/^[\w-]+\.ts: /, ""))), []);
});

test("the first known language is taken: asked for, chosen by the publisher, of the browser", () => {
  assert.equal(chooseLanguage([null, undefined, "fr-CH", "de-AT", "en"]), "de");
  assert.equal(chooseLanguage(["EN_us", "de"]), "en");
  assert.equal(chooseLanguage(["tlh", ""]), "en");
});

test("numbers, shares and plurals are written as in the language", (t) => {
  t.after(() => useWords("en", read("en")));
  assert.deepEqual(
    [formatCount(12_400), formatGaussians(1), formatGaussians(950), formatShare(0.0004)],
    ["12.4 k", "1 Gaussian", "950 Gaussians", "under 0.1%"],
  );
  assert.equal(text("why.share", { count: 1 }), "It alone makes this pixel.");
  useWords("de", read("de"));
  assert.deepEqual(
    [formatCount(12_400), formatShare(0.0004), formatLength(2.5, 1)],
    ["12,4 k", "unter 0,1\u00a0%", "2,50 m"],
  );
  assert.equal(text("why.seen", { count: 1, of: 12_000 }), "Er ist hier, weil 1 von 12.000 Zellen ihn sieht.");
});
