// What is known of a scene before its first Gaussian, from WELCOME or any JSON with the same keys; all of it is
// checked.
import { schemaMetadata } from "./arrow.ts";
import { codeOf } from "./coding.ts";
import { type Fields, integer, list, number, object, refuse, triple } from "./json.ts";
import type { ColorTables, Header, Level } from "./types.ts";
import { termWidths } from "./tables.ts";
import { FAULTS, PROTOCOL, ProtocolError, WELCOME } from "./wire.ts";

const MOST = 2 ** 28; // Gaussians, and terms
const MOST_BYTES = 1 << 20;
const MOST_DECAY = 1e4, MOST_STEP = 2 ** 15;
const LEAST = 1.1754943508222875e-38; // the smallest normal float32

/** Return the header that a WELCOME holds; raise ProtocolError for anything else. */
export function parseWelcome(message: Uint8Array): Header {
  if (message.length < 8 || message.length > MOST_BYTES || message[0] !== WELCOME) {
    throw new ProtocolError(`message: expected WELCOME, got ${message.length} bytes of another kind`);
  }
  if (message[1] !== PROTOCOL) {
    throw new ProtocolError(`WELCOME: expected version ${PROTOCOL}, got ${message[1]}`, FAULTS.version);
  }
  const text = schemaMetadata(message.subarray(8), "gsvis");
  let said: unknown;
  try {
    said = JSON.parse(text);
  } catch {
    throw new ProtocolError("WELCOME: expected JSON, got other text");
  }
  return withCode(headerOf(said, "WELCOME"), object(said, "WELCOME"), "WELCOME");
}

/** Return the header that a parsed JSON object describes; `where` names it in errors. */
export function headerOf(said: unknown, where: string): Header {
  const o = object(said, where);
  const gaussians = integer(o, "gaussians", 0, MOST, where);
  const colors = colorsOf(object(o["colors"], `${where}, colors`), `${where}, colors`);
  const termBits = termWidths(colors).reduce((sum, width) => sum + width, 0);
  const levels = list(o, "levels", 1, 16, where).map((level) => levelOf(level, gaussians, where));
  const up = triple(o["up"], `${where}, up`);
  const length = Math.hypot(...up);
  const identity = o["identity"];
  if (!(length > 0)) refuse(`${where}, up`, "a direction", up);
  if (typeof identity !== "string" || !/^[0-9a-f]{64}$/.test(identity)) {
    refuse(`${where}, identity`, "64 hexadecimal digits", identity);
  }
  if (termBits > 64) refuse(where, "terms of at most 64 bits", termBits);
  if (integer(o, "record_bytes", 0, 64, where) !== 16) refuse(`${where}, record_bytes`, "16", o["record_bytes"]);
  if (integer(o, "term_bits", 0, 64, where) !== termBits) refuse(`${where}, term_bits`, `${termBits}`, o["term_bits"]);
  return {
    gaussians,
    terms: integer(o, "terms", 0, Math.min(255 * gaussians, MOST), where),
    chunks: integer(o, "chunks", 0, gaussians, where),
    levels,
    termBits,
    colors,
    harmonics: null,
    up: [up[0] / length, up[1] / length, up[2] / length],
    metersPerUnit: number(o["meters_per_unit"], 0, Number.MAX_VALUE, `${where}, meters_per_unit`),
    antialiased: o["antialiased"] === true,
    identity: identity as string,
    code: null,
  };
}

/** Return a header with the code of its records. */
export function withCode(header: Header, o: Fields, where: string): Header {
  const text = o["code"], steps = o["steps"] === null ? null : object(o["steps"], `${where}, steps`);
  if (typeof text !== "string") return refuse(`${where}, code`, "text", text);
  const limit = (of: Fields, name: string) => integer(of, name, -MOST_STEP, MOST_STEP, `${where}, steps`);
  const limits = steps && { place: limit(steps, "place"), turn: limit(steps, "turn") };
  return { ...header, code: codeOf(text, header.colors, limits) };
}

function levelOf(said: unknown, gaussians: number, where: string): Level {
  const o = object(said, `${where}, levels`);
  if (typeof o["name"] !== "string") refuse(`${where}, levels`, "a name", o["name"]);
  return { name: (o["name"] as string).slice(0, 100), count: integer(o, "count", 0, gaussians, `${where}, levels`) };
}

function colorsOf(o: Fields, where: string): ColorTables {
  const variant = o["variant"];
  if (variant !== "rgb" && variant !== "hsl") refuse(`${where}, variant`, "rgb or hsl", variant);
  const bits = object(o["precision"], `${where}, precision`);
  const part = (name: string, most: number) => integer(bits, name, 2, most, `${where}, precision`);
  const pair = (value: unknown, name: string, low: number, high: number): [number, number] => {
    if (!Array.isArray(value) || value.length !== 2) return refuse(`${where}, ${name}`, "two numbers", value);
    const least = number(value[0], low, high, `${where}, ${name}`);
    return [least, number(value[1], least, high, `${where}, ${name}`)];
  };
  return {
    variant: variant as "rgb" | "hsl",
    precision: {
      name: String(bits["name"]).slice(0, 100),
      base: part("base", 8), scale: part("scale", variant === "hsl" ? 8 : 16), axis: part("axis", 16),
      center: part("center", 15),
      decay: part("decay", 16), intensity: part("intensity", 16),
    },
    base: list(o, "base", 3, 3, where).map((value) => pair(value, "base", -1e30, 1e30)),
    scales: pair(o["scales"], "scales", LEAST, 1e30),
    decays: pair(o["decays"], "decays", LEAST, MOST_DECAY),
    intensity: number(o["intensity"], 0, 1e30, `${where}, intensity`),
  };
}
