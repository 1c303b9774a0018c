// Write the types of the module `gsvis-viewer` as one file: what index.ts exports, and what that needs.
// Interfaces and types stand as in the sources, with all their comments; functions and classes as tsc declares them.
import { execFileSync } from "node:child_process";
import { readdirSync, readFileSync, rmSync } from "node:fs";
import { basename, join } from "node:path";
import { fileURLToPath } from "node:url";

const here = fileURLToPath(new URL(".", import.meta.url));
const HEAD = `// Types of gsvis-viewer.js, made by "npm run build" in viewer/. Its README says how to use the module.

`;
// A declaration begins at the margin, perhaps with a comment before it; its other lines do not, or close it.
const COMMENT = String.raw`(?:\/\*\*(?:(?!\*\/)[^])*\*\/\n)?`;
const DECLARATION = new RegExp(
  `^${COMMENT}(?:export )?(?:declare )?(interface|type|class|function|const) (\\w+)\\b.*\\n(?:[ })].*\\n)*`, "gm");

/** Return the declarations of a text by name. */
function declarationsOf(text) {
  return new Map([...text.matchAll(DECLARATION)].map(([whole, kind, name]) => [name, { kind, text: whole }]));
}

/** Return the text of gsvis-viewer.d.ts. */
export function bundleTypes() {
  const folder = join(here, ".types");
  rmSync(folder, { recursive: true, force: true });
  try {
    const tsc = join(here, "node_modules/typescript/bin/tsc");
    execFileSync(process.execPath, [tsc, "-p", join(here, "tsconfig.types.json")]);
    return joinTypes(folder);
  } finally {
    rmSync(folder, { recursive: true, force: true });
  }
}

/** Return the text of element.d.ts. */
export function elementTypes() {
  const folder = join(here, ".element-types");
  try {
    const options = "--declaration --emitDeclarationOnly --strict --target es2022 --module esnext --moduleResolution bundler";
    const more = ["--lib", "es2022,dom", "--types", "", "--allowImportingTsExtensions", "--ignoreConfig", "--outDir", folder];
    const tsc = join(here, "node_modules/typescript/bin/tsc"), source = join(here, "src/embed/element.ts");
    execFileSync(process.execPath, [tsc, ...options.split(" "), ...more, source]);
    return readFileSync(join(folder, "element.d.ts"), "utf8");
  } finally {
    rmSync(folder, { recursive: true, force: true });
  }
}

/** Join the declarations that index.d.ts exports, and those that they name. */
function joinTypes(folder) {
  const all = new Map(), index = readFileSync(join(folder, "index.d.ts"), "utf8"), asked = new Set();
  for (const file of readdirSync(folder).filter((name) => name !== "index.d.ts")) {
    const module = basename(file, ".d.ts");
    const source = declarationsOf(readFileSync(join(here, "src/core", `${module}.ts`), "utf8"));
    for (const [name, { kind, text }] of declarationsOf(readFileSync(join(folder, file), "utf8"))) {
      const written = kind === "interface" || kind === "type" ? source.get(name)?.text : undefined;
      (all.get(name) ?? all.set(name, []).get(name)).push({ module, text: written ?? text });
    }
    if (index.includes(`export type * from "./${module}.ts"`)) for (const name of source.keys()) asked.add(name);
  }
  for (const [, names] of index.matchAll(/^export (?:type )?\{([^}]*)\}/gm)) {
    for (const name of names.match(/\w+(?=\s*(?:,|$))/g)) asked.add(name);
  }
  const exported = new Set(asked), blocks = [];
  for (const name of asked) { // grows while it is walked through
    const found = all.get(name) ?? [];
    if (found.length !== 1) throw new Error(`types: expected one declaration of ${name}, got ${found.length}`);
    blocks.push({ name, ...found[0] });
    const code = found[0].text.replace(/\/\*[^]*?\*\/|\/\/.*/g, "");
    for (const word of new Set(code.match(/\b[A-Z]\w*/g))) if (all.has(word)) asked.add(word);
  }
  const head = new RegExp(`^(${COMMENT})(?:export )?(?:declare )?(interface|type|class|function|const)`);
  const texts = blocks.map(({ name, text }) => text.replace(head, (_, comment, kind) => {
    const words = [exported.has(name) ? "export " : "", /interface|type/.test(kind) ? "" : "declare "];
    return comment + words.join("") + kind;
  }));
  return `${HEAD}${texts.join("\n")}\nexport {};\n`;
}
