// The messages of docs/streaming.md that are not batches: those of a client, and ERROR. Little-endian, byte 0 is the
// kind.
import type { Pose, View } from "./types.ts";

/** Version of the messages. */
export const PROTOCOL = 3;
/** Kinds of messages from the server. */
export const WELCOME = 129;
export const BATCH = 130;
export const ERROR = 131;
/** Codes of ERROR. */
export const FAULTS = {
  malformed: 1, version: 2, tooLarge: 3, refused: 4, tooMany: 5, flood: 6, late: 7, internal: 8, ending: 9,
} as const;

const HELLO_BYTES = 72;
const MOST_LINE = 1000;

/** A message that breaks a rule. `code` is one of `FAULTS`. */
export class ProtocolError extends Error {
  readonly code: number;

  constructor(message: string, code: number = FAULTS.malformed) {
    super(message);
    this.name = "ProtocolError";
    this.code = code;
  }
}

/**
 * What a HELLO adds to a `View`: radians around it, where it begins in front of the eye, and the bytes of records that
 * the client holds at most, 0 for no limit.
 */
export interface Reach {
  margin: number;
  near: number;
  memory: number;
}

/** Return a HELLO. `identity` and `holdings` are of the scene that is held; empty for nothing. */
export function hello(view: View, reach: Reach, identity = "", holdings = new Uint8Array(0)): Uint8Array<ArrayBuffer> {
  const out = new Uint8Array(HELLO_BYTES + holdings.length);
  const data = new DataView(out.buffer);
  out.set([1, PROTOCOL]);
  data.setUint32(4, holdings.length, true);
  [
    view.left, view.right, view.up, view.down, reach.margin, reach.near,
  ].forEach((value, k) => data.setFloat32(8 + 4 * k, value, true));
  for (let k = 0; k < identity.length / 2; k++) out[32 + k] = parseInt(identity.slice(2 * k, 2 * k + 2), 16);
  data.setUint32(64, reach.memory % 2 ** 32, true);
  data.setUint32(68, reach.memory / 2 ** 32, true);
  out.set(holdings, HELLO_BYTES);
  return out;
}

/** Return a POSE; `milliseconds` are of any clock of the client. */
export function poseAt(milliseconds: number, pose: Pose): Uint8Array<ArrayBuffer> {
  const out = new Uint8Array(36);
  const data = new DataView(out.buffer);
  out[0] = 2;
  data.setUint32(4, Math.floor(milliseconds) % 2 ** 32, true);
  [...pose.position, ...pose.rotation].forEach((value, k) => data.setFloat32(8 + 4 * k, value, true));
  return out;
}

/** Return an ACK: all messages up to this one have arrived. */
export function ack(sequence: number): Uint8Array<ArrayBuffer> {
  const out = new Uint8Array(8);
  out[0] = 3;
  new DataView(out.buffer).setUint32(4, sequence, true);
  return out;
}

/** Return a BYE. */
export function bye(): Uint8Array<ArrayBuffer> {
  return Uint8Array.of(4, 0, 0, 0);
}

/** Whether a text can be a token: 1 to 1000 printable ASCII characters. */
export function isToken(text: string): boolean {
  return /^[\x20-\x7e]{1,1000}$/.test(text);
}

/** Return a TOKEN, which comes before HELLO: a page cannot set headers of a WebSocket. */
export function tokenOf(text: string): Uint8Array<ArrayBuffer> {
  const out = new Uint8Array(4 + text.length);
  out.set([5, 0, text.length & 255, text.length >>> 8]);
  for (let k = 0; k < text.length; k++) out[4 + k] = text.charCodeAt(k);
  return out;
}

/** Return the code and the line of an ERROR. */
export function parseError(message: Uint8Array): { code: number; line: string } {
  const length = message.length < 4 ? 0 : message[2] | (message[3] << 8);
  if (message[0] !== ERROR || length > MOST_LINE || message.length !== 4 + length) {
    throw new ProtocolError(`ERROR: expected ${4 + length} bytes, got ${message.length}`);
  }
  const line = new TextDecoder().decode(message.subarray(4)).replace(/[\u0000-\u001f\u007f]+/g, " ").trim();
  return { code: message[1], line };
}

/** Whether a pose can be sent: finite numbers in float32, and a rotation. */
export function isPose(pose: Pose): boolean {
  const norm = Math.hypot(...pose.rotation);
  return [...pose.position, ...pose.rotation].every((value) => Number.isFinite(Math.fround(value))) && norm > 1e-5 &&
    norm < 1e5;
}

/** Whether a view can be sent: an image with an inside, of sensible size. */
export function isView(view: View): boolean {
  const all = [view.left, view.right, view.up, view.down];
  return all.every((value) => Math.abs(value) < 1e6) && view.left + view.right > 1e-6 && view.up + view.down > 1e-6;
}
