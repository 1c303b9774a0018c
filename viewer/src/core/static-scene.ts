// What a static scene says of itself (docs/static.md): scene.json, checked.
import { headerOf, withCode } from "./header.ts";
import { type Fields, integer, list, number, object, refuse, triple } from "./json.ts";
import { blocksOf, type SetBlocks } from "./static-sets.ts";
import type { HarmonicTables, Header, Pose } from "./types.ts";

const VERSION = 8;
const MOST = 1 << 28;
const FARTHEST = 1e30;
const WHERE = "scene.json";
const NAME = /^[a-z]+-[0-9a-f]{16}(\.bin)?$/;

/** A file, or several of a kind, which are numbered. */
export interface StaticFile {
  name: string;
  bytes: number;
  count: number;
}

interface CellInfo {
  count: number;
  origin: number[];
  size: number; // 0: one cell that sees everything
  gainTop: number;
  active: boolean;
  spheres: boolean; // whether rows say where the light of parts is
  glances: { sectors: number; axes: readonly number[][] } | null; // of the horizon: two axes, and the one upwards
}

export interface StaticScene {
  header: Header;
  parts: number;
  middle: [number, number, number]; // where centers of parts are finest
  scale: number;
  cells: CellInfo;
  poses: Pose[];
  first: { bytes: number; pose: Pose }[]; // the file of each first view
  files: Map<string, StaticFile>;
  sets: SetBlocks; // of harmonics
}

/** Return the content of scene.json; throw one clear line where it is of another format, a newer version or damaged. */
export function parseScene(text: string): StaticScene {
  let said: unknown;
  try {
    said = JSON.parse(text);
  } catch {
    throw new Error(`${WHERE}: expected JSON, got something else; is this the address of a static scene?`);
  }
  const top = object(said, WHERE);
  if (top.format !== "gsvis-static") refuse(WHERE, "a static scene of gsvis", top.format);
  if (top.version !== VERSION) {
    throw new Error(`${WHERE}: expected version ${VERSION}, got ${String(top.version)}; export the scene again`);
  }
  const places = object(top.places, `${WHERE}, places`), known = headerOf(top, WHERE);
  const files = parseFiles(object(top.files, `${WHERE}, files`)), isPlain = files.has("plain");
  const scene: StaticScene = {
    header: {
      ...(isPlain ? { ...known, plain: true } : withCode(known, top, WHERE)),
      harmonics: top.harmonics === null ? null : parseHarmonics(top.harmonics),
    },
    files, sets: parseBlocks(isPlain ? null : top.harmonics),
    parts: integer(top, "parts", 0, known.gaussians, WHERE),
    middle: triple(places.middle, `${WHERE}, places, middle`),
    scale: number(places.scale, 0, FARTHEST, `${WHERE}, places, scale`),
    cells: parseCells(object(top.cells, `${WHERE}, cells`), `${WHERE}, cells`),
    poses: list(top, "poses", 0, MOST, WHERE).map(
      (each) => parsePose(object(each, `${WHERE}, poses`), `${WHERE}, poses`),
    ),
    first: list(top, "first", 0, MOST, WHERE).map((each) => {
      const where = `${WHERE}, first`, said = object(each, where);
      return { bytes: integer(said, "bytes", 0, MOST, where), pose: parsePose(said, where) };
    }),
  };
  checkFiles(scene);
  return scene;
}

function parseFiles(said: Fields): Map<string, StaticFile> {
  const files = new Map<string, StaticFile>();
  for (const [kind, value] of Object.entries(said)) {
    const where = `${WHERE}, files, ${kind}`, file = object(value, where), { name } = file;
    if (typeof name !== "string" || !NAME.test(name)) return refuse(where, "a name without a path", name);
    files.set(kind, { name, bytes: integer(file, "bytes", 0, 2 ** 40, where), count: integer(file, "count", 0, MOST, where) });
  }
  return files;
}

function parseCells(said: Fields, where: string): CellInfo {
  return {
    count: integer(said, "count", 0, 1e6, where), origin: triple(said.origin, `${where}, origin`),
    size: number(said.size, 0, FARTHEST, `${where}, size`),
    gainTop: number(said.gain_top, -FARTHEST, FARTHEST, `${where}, gain_top`), active: said.active === true,
    spheres: said.spheres === true, glances: parseGlances(said.glances ?? null, `${where}, glances`),
  };
}

function parseGlances(value: unknown, where: string): CellInfo["glances"] {
  if (value === null) return null;
  const said = object(value, where);
  const axes = list(said, "axes", 3, 3, where).map((axis) => triple(axis, `${where}, axes`));
  return { sectors: integer(said, "sectors", 1, 360, where), axes };
}

function checkFiles(scene: StaticScene): void {
  const { header, files, parts, cells, first } = scene, wanted = new Map([["index", 1], ["grid", 1], ["row", cells.count]]);
  wanted.set(header.plain ? "plain" : "part", parts);
  if (header.terms > 0) wanted.set("terms", parts);
  if (first.length > 0) wanted.set("first", first.length);
  if (cells.glances !== null) wanted.set("glance", cells.count * cells.glances.sectors);
  if (header.harmonics !== null && !header.plain) wanted.set("sets", scene.sets.bytes.length);
  for (const [kind, count] of wanted) {
    const got = files.get(kind)?.count;
    if (got !== count) refuse(`${WHERE}, files, ${kind}`, `${count} files`, got);
  }
}

function parsePose(said: Fields, where: string): Pose {
  const [w, x, y, z] = numbers(said, "rotation", 4, where);
  return { position: triple(said.position, `${where}, position`), rotation: [w, x, y, z] };
}

function parseHarmonics(value: unknown): HarmonicTables {
  const where = `${WHERE}, harmonics`, said = object(value, where),
    degree = integer(said, "degree", 1, 3, where) as 1 | 2 | 3;
  const count = (degree + 1) ** 2 - 1;
  const sets = integer(said, "sets", 1, MOST, where);
  return { degree, low: numbers(said, "low", count, where), high: numbers(said, "high", count, where), sets };
}

/** Return the bytes and the worth of each block of sets; nothing where there are none. */
function parseBlocks(value: unknown): SetBlocks {
  if (value === null) return { bytes: [], worth: [] };
  const where = `${WHERE}, harmonics`, said = object(value, where), { sets } = parseHarmonics(value);
  return { bytes: numbers(said, "bytes", blocksOf(sets), where), worth: numbers(said, "worth", blocksOf(sets), where) };
}

function numbers(o: Fields, key: string, count: number, where: string): number[] {
  return list(o, key, count, count, where).map((value) => number(value, -FARTHEST, FARTHEST, `${where}, ${key}`));
}
