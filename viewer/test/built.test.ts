// What is built: types that a small program of somebody else is checked against, names, and how much a page weighs.
import assert from "node:assert/strict";
import { spawnSync } from "node:child_process";
import { cpSync, mkdirSync, mkdtempSync, readdirSync, readFileSync, rmSync, symlinkSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { test } from "node:test";
import { pathToFileURL } from "node:url";
import { gzipSync } from "node:zlib";
import OWN from "../own-names.json" with { type: "json" };

const BUILT = join(process.cwd(), "../gsvis/viewer");

test("a program that uses the module as a package passes a strict check of types", (t) => {
  const folder = mkdtempSync(join(tmpdir(), "gsvis-types-"));
  t.after(() => rmSync(folder, { recursive: true }));
  mkdirSync(join(folder, "node_modules"));
  symlinkSync(BUILT, join(folder, "node_modules/gsvis-viewer"));
  cpSync("test/consumer/index.ts", join(folder, "index.ts"));
  writeFileSync(join(folder, "package.json"), '{"type": "module"}');
  for (const module of ["nodenext", "esnext"]) {
    const options = {
      strict: true, noEmit: true, target: "es2022", module, types: [], lib: ["es2022", "dom"],
      exactOptionalPropertyTypes: true,
    };
    const resolution = module === "esnext" ? { moduleResolution: "bundler" } : {};
    writeFileSync(
      join(folder, "tsconfig.json"),
      JSON.stringify({ compilerOptions: { ...options, ...resolution }, include: ["index.ts"] }),
    );
    const found = spawnSync(process.execPath, ["node_modules/typescript/bin/tsc", "-p", folder], { encoding: "utf8" });
    assert.equal(found.stdout + found.stderr, "");
    assert.equal(found.status, 0);
  }
});

test("the types declare what the script exports, nothing more and nothing less", async () => {
  const types = readFileSync(join(BUILT, "gsvis-viewer.d.ts"), "utf8");
  const declared = [...types.matchAll(/^export declare (?:function|class|const) (\w+)/gm)].map(([, name]) => name);
  const script = await import(pathToFileURL(join(BUILT, "gsvis-viewer.js")).href) as object;
  assert.deepEqual(declared.sort(), Object.keys(script).sort());
});

test("the page of a stream and the page of a static scene weigh at most 70 kB, gzipped", () => {
  const weigh = (name: string): number => gzipSync(readFileSync(join(BUILT, name)), { level: 9 }).length;
  const shared = ["view.html", "page.css", "page.js", "sort.js"].reduce((sum, name) => sum + weigh(name), 0);
  for (const reader of ["network.js", "static.js"]) {
    assert.ok(
      shared + weigh(reader) <= 70_000, `${reader}: ${shared + weigh(reader)}`,
    );
  }
});

test("no name that the build shortens in a script is read from JSON there", () => {
  const sources = readdirSync("src", { recursive: true, encoding: "utf8" }).filter((name) => name.endsWith(".ts"));
  let count = 0;
  for (const name of sources) {
    const own: string[] = name.startsWith("core") ? Object.values(OWN).flat() : OWN.page;
    const text = readFileSync(join("src", name), "utf8");
    const objects = [...text.matchAll(/(\w+): Fields\b|const (\w+) = (?:object|fields)\(/g)].map(([, a, b]) => a ?? b);
    const read = [...text.matchAll(/const \{([^}]*)\} = (?:object|fields)\(/g)].flatMap(([, keys]) => keys.match(/\w+/g)!);
    for (const each of new Set(objects)) {
      for (const [, key] of text.matchAll(new RegExp(`\\b${each}\\.(\\w+)`, "g"))) read.push(key);
    }
    count += read.length;
    assert.deepEqual(read.filter((key) => own.includes(key)), [], name);
  }
  assert.ok(count > 20, `${count} reads found`);
});
