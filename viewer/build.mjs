// Bundle the viewer into gsvis/viewer, with types and package.json: that folder is the npm package `gsvis-viewer`.
// `--check` compares with what lies there; `--tests` bundles the tests instead.
import { build, transform } from "esbuild";
import { minify } from "terser";
import { mkdirSync, readdirSync, readFileSync, writeFileSync } from "node:fs";
import { gzipSync } from "node:zlib";
import { basename, dirname, join } from "node:path";
import { fileURLToPath } from "node:url";
import { shorten } from "./shaders.mjs";
import { bundleTypes, elementTypes } from "./types.mjs";

const here = dirname(fileURLToPath(import.meta.url));
const out = join(here, "../gsvis/viewer");
const common = {
  bundle: true, format: "esm", target: "es2022", write: false, charset: "utf8", legalComments: "none",
  absWorkingDir: here,
};

const shaders = {
  name: "shaders",
  setup({ onLoad }) {
    onLoad({ filter: /shaders\.ts$/ }, ({ path }) => ({ contents: shorten(readFileSync(path, "utf8")), loader: "ts" }));
  },
};

// Names of properties in the own classes of a script alone: no browser, JSON, other script or program sees them. The
// build shortens them everywhere in the script, so a name that JSON has too would never be found there.
const OWN = JSON.parse(readFileSync(join(here, "own-names.json"), "utf8"));
const mangleOf = (path) => {
  const names = OWN[basename(path, ".js")];
  return names ? { properties: { builtins: true, regex: new RegExp(`^(${names.join("|")})$`) } } : {};
};

if (process.argv.includes("--tests")) {
  const tests = readdirSync(join(here, "test")).filter((name) => name.endsWith(".test.ts"));
  await build({
    ...common, write: true, platform: "node", outdir: join(here, ".tests"), outExtension: { ".js": ".mjs" },
    entryPoints: tests.map((name) => join(here, "test", name)),
  });
} else {
  const bundled = await build({
    ...common, minify: true, outdir: out, plugins: [shaders],
    entryPoints: {
      "gsvis-viewer": join(here, "src/core/index.ts"),
      network: join(here, "src/core/network.worker.ts"),
      sort: join(here, "src/core/sort.worker.ts"),
      static: join(here, "src/core/static.worker.ts"),
      page: join(here, "src/page/index.ts"),
      xr: join(here, "src/core/xr.ts"),
      tour: join(here, "src/page/timeline.ts"),
      hotspots: join(here, "src/page/hotspots.ts"),
      author: join(here, "src/page/author.ts"),
      embed: join(here, "src/embed/answer.ts"),
      element: join(here, "src/embed/element.ts"),
      list: join(here, "src/page/listing.ts"),
    },
  });
  const files = await Promise.all(bundled.outputFiles.map(async ({ path, text }) => {
    const { code } = await minify(text, {
      module: true, ecma: 2020, format: { ascii_only: false }, mangle: mangleOf(path),
      compress: { passes: 5, unsafe: true, unsafe_arrows: true, unsafe_methods: true, pure_getters: true },
    });
    return { path, bytes: Buffer.from(code) };
  }));
  const words = (language) => JSON.parse(readFileSync(join(here, `src/page/words/${language}.json`), "utf8"));
  const english = words("en"); // what a page says without its scripts is English
  const html = (name) => readFileSync(join(here, "src/page", name), "utf8").replaceAll(/%([\w.]+)%/g, (_, key) => english[key]);
  for (const name of ["view.html", "list.html"]) files.push({ path: join(out, name), bytes: Buffer.from(html(name)) });
  for (const name of readdirSync(join(here, "src/page/words"))) {
    const language = basename(name, ".json"), text = JSON.stringify(words(language));
    if (language === "en") continue; // part of page.js
    files.push({
      path: join(out, `words-${language}.js`), bytes: Buffer.from(`(globalThis.gsvisParts??={})["words-${language}"]=${text};\n`),
    });
  }
  const page = html("view.html").replaceAll("../viewer/", "./");
  files.push({ path: join(out, "page.html"), bytes: Buffer.from(page) }); // beside the scripts, as the element finds it
  files.push({ path: join(out, "gsvis-viewer.d.ts"), bytes: Buffer.from(bundleTypes()) });
  files.push({ path: join(out, "element.d.ts"), bytes: Buffer.from(elementTypes()) });
  files.push({ path: join(out, "README.md"), bytes: readFileSync(join(here, "README.md")) });
  files.push({ path: join(out, "LICENSE"), bytes: readFileSync(join(here, "../LICENSE")) });
  const { name, version, description, license } = JSON.parse(readFileSync(join(here, "package.json"), "utf8"));
  const types = "./gsvis-viewer.d.ts", element = { types: "./element.d.ts", default: "./element.js" };
  const exports = { ".": { types, default: "./gsvis-viewer.js" }, "./element": element, "./*": "./*" };
  const manifest = JSON.stringify({ name, version, description, license, type: "module", types, exports }, null, 2);
  files.push({ path: join(out, "package.json"), bytes: Buffer.from(`${manifest}\n`) });
  for (const name of ["page.css", "list.css"]) {
    const style = await transform(readFileSync(join(here, "src/page", name), "utf8"), {
      loader: "css", minify: true, target: common.target, charset: "utf8",
    });
    files.push({ path: join(out, name), bytes: Buffer.from(style.code) });
  }
  let differ = 0;
  mkdirSync(out, { recursive: true });
  for (const { path, bytes } of files) {
    const name = path.slice(out.length + 1);
    if (process.argv.includes("--check")) {
      let old = Buffer.alloc(0);
      try { old = readFileSync(path); } catch { /* absent: differs */ }
      if (!old.equals(bytes)) {
        differ += 1;
        console.error(`gsvis/viewer/${name} is not what its sources build: npm run build`);
      }
    } else {
      writeFileSync(path, bytes);
      console.log(`${name}: ${bytes.length} bytes, ${gzipSync(bytes, { level: 9 }).length} gzipped`);
    }
  }
  if (differ) process.exit(1);
}
