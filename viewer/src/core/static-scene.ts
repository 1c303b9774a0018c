// What a static scene says of itself (docs/static.md): scene.json checked, its chunks and blocks as tables.
import { headerOf } from "./header.ts";
import type { HarmonicTables, Header, Pose } from "./types.ts";

export const BLOCK = 64;
const MOST = 1 << 28;
const NAME = /^[a-z]+-[0-9a-f]{16}\.bin$/;

export interface StaticFile {
  name: string;
  bytes: number;
}

export interface CellInfo {
  count: number;
  origin: number[];
  size: number; // 0: one cell that sees everything
  gainTop: number;
  active: boolean;
}

export interface StaticScene {
  header: Header;
  blocks: number;
  termBytes: number;
  cells: CellInfo;
  poses: Pose[];
  files: Map<string, StaticFile>;
}

type Fields = Record<string, unknown>;

/** Return the content of scene.json; throw one clear line where it is of another format, a newer version or damaged. */
export function parseScene(text: string): StaticScene {
  let said: unknown;
  try {
    said = JSON.parse(text);
  } catch {
    throw new Error("scene.json: expected JSON, got something else; is this the address of a static scene?");
  }
  const top = object(said, "scene.json");
  if (top.format !== "gsvis-static") throw new Error("scene.json: expected a static scene of gsvis, got something else");
  if (top.version !== 1) throw new Error(`scene.json: expected version 1, got ${String(top.version)}; update the page`);
  if (top.block_gaussians !== BLOCK) throw new Error("scene.json: expected blocks of 64 Gaussians");
  const files = new Map<string, StaticFile>();
  for (const [kind, value] of Object.entries(object(top.files, "files"))) {
    const file = object(value, `files.${kind}`);
    if (typeof file.name !== "string" || !NAME.test(file.name)) throw new Error(`scene.json: files.${kind}: expected a name without a path`);
    files.set(kind, { name: file.name, bytes: whole(file.bytes, `files.${kind}.bytes`, 2 ** 40) });
  }
  const cells = object(top.cells, "cells");
  const header: Header = { ...headerOf(top, "scene.json"), harmonics: top.harmonics === null ? null : parseHarmonics(top.harmonics) };
  const scene: StaticScene = {
    header, files,
    blocks: whole(top.blocks, "blocks", MOST),
    termBytes: whole(top.term_bytes, "term_bytes", 8),
    cells: {
      count: whole(cells.count, "cells.count", 1e6), origin: triple(cells.origin, "cells.origin"), size: finite(cells.size, "cells.size"),
      gainTop: finite(cells.gain_top, "cells.gain_top"), active: cells.active === true,
    },
    poses: list(top.poses, "poses").map((each) => parsePose(object(each, "poses"))),
  };
  checkSizes(scene);
  return scene;
}

function checkSizes(scene: StaticScene): void {
  const { header, files } = scene;
  const k = header.harmonics === null ? 0 : (header.harmonics.degree + 1) ** 2 - 1;
  const wanted: [string, number][] = [["chunks", 32 * header.chunks], ["records", 16 * header.gaussians], ["grid", 16 * scene.cells.count]];
  if (k > 0) wanted.push(["harmonics", 3 * k * header.gaussians]);
  if (header.terms > 0) wanted.push(["blocks", 2 * scene.blocks], ["terms", header.gaussians + scene.termBytes * header.terms]);
  for (const [kind, bytes] of wanted) {
    const got = files.get(kind)?.bytes;
    if (got !== bytes) throw new Error(`scene.json: files.${kind}: expected ${bytes} bytes, got ${got ?? "no file"}`);
  }
  if (!files.has("cells")) throw new Error("scene.json: files.cells: expected a file, got none");
}

function parsePose(said: Fields): Pose {
  const r = list(said.rotation, "rotation").map((v) => finite(v, "rotation"));
  if (r.length !== 4) throw new Error("scene.json: rotation: expected four numbers");
  return { position: triple(said.position, "position"), rotation: [r[0], r[1], r[2], r[3]] };
}

function parseHarmonics(value: unknown): HarmonicTables {
  const said = object(value, "harmonics"), degree = whole(said.degree, "harmonics.degree", 3);
  if (degree !== 1 && degree !== 2 && degree !== 3) throw new Error(`scene.json: harmonics.degree: expected 1 to 3, got ${degree}`);
  const ends = (key: string): number[] => list(said[key], `harmonics.${key}`).map((v) => finite(v, `harmonics.${key}`));
  const found: HarmonicTables = { degree, low: ends("low"), high: ends("high") };
  const k = (degree + 1) ** 2 - 1;
  if (found.low.length !== k || found.high.length !== k) throw new Error(`scene.json: harmonics: expected ${k} low and high ends`);
  return found;
}

function object(value: unknown, where: string): Fields {
  if (typeof value !== "object" || value === null || Array.isArray(value)) throw new Error(`scene.json: ${where}: expected an object`);
  return value as Fields;
}

function list(value: unknown, where: string): unknown[] {
  if (!Array.isArray(value)) throw new Error(`scene.json: ${where}: expected a list`);
  return value;
}

function finite(value: unknown, where: string): number {
  if (typeof value !== "number" || !Number.isFinite(value)) throw new Error(`scene.json: ${where}: expected a number`);
  return value;
}

function whole(value: unknown, where: string, most: number): number {
  const found = finite(value, where);
  if (!Number.isInteger(found) || found < 0 || found > most) throw new Error(`scene.json: ${where}: expected a whole number up to ${most}, got ${found}`);
  return found;
}

function triple(value: unknown, where: string): [number, number, number] {
  const found = list(value, where).map((v) => finite(v, where));
  if (found.length !== 3) throw new Error(`scene.json: ${where}: expected three numbers`);
  return [found[0], found[1], found[2]];
}
