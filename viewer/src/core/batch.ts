// A BATCH as its lists of ids and its rows, checked in everything that does not need what came before. Records stay
// coded.
import { recordBatchRows } from "./arrow.ts";
import { peek, readCodes, wordsOf } from "./bits.ts";
import type { Header } from "./types.ts";
import { BATCH, FAULTS, ProtocolError } from "./wire.ts";

/** Bytes of the row of a chunk. */
export const CHUNK_BYTES = 33;
const MOST_BYTES = 2 ** 28;
const MOST_ORDER = 24;
const IDS_AT = 22; // bytes before the string of bits

/** The content of a BATCH. Lists of ids rise; owners never fall. */
export interface Sections {
  sequence: number;
  chunks: Uint32Array; // (C) first id of each chunk
  rows: Uint8Array; // (33 C)
  gaussians: Uint32Array; // (G)
  records: Uint8Array; // coded
  terms: Uint32Array; // (M)
  owners: Uint32Array; // (M) ids
  termRecords: Uint8Array; // coded
  gone: Uint32Array; // (D)
  evicted: Uint32Array; // (E)
}

/** Return the number of a BATCH, and raise ProtocolError unless it begins as one. */
export function sequenceOf(message: Uint8Array): number {
  if (message.length < 8 || message[0] !== BATCH || message[1] !== 0 || message[2] !== 0 || message[3] !== 0) {
    throw new ProtocolError(`message: expected BATCH, got ${message.length} bytes of another kind`);
  }
  if (message.length > MOST_BYTES) {
    throw new ProtocolError(`BATCH: expected at most ${MOST_BYTES} bytes, got ${message.length}`, FAULTS.tooLarge);
  }
  return new DataView(message.buffer, message.byteOffset).getUint32(4, true);
}

/** Return the content of a BATCH of a scene; raise ProtocolError if it does not fit. */
export function parseBatch(message: Uint8Array, about: Header): Sections {
  const sequence = sequenceOf(message);
  const refuse = (expected: string, got: string): never => {
    throw new ProtocolError(`BATCH ${sequence}: expected ${expected}, got ${got}`);
  };
  const [ids, rows, records, termRecords] = recordBatchRows(message.subarray(8), refuse);
  if (rows.length % CHUNK_BYTES !== 0) refuse(`a multiple of ${CHUNK_BYTES} bytes`, `${rows.length}`);
  const [chunks, gaussians, terms, owners, gone, evicted] = parseIds(ids, rows.length / CHUNK_BYTES, about, refuse);
  return { sequence, chunks, rows, gaussians, records, terms, owners, termRecords, gone, evicted };
}

/** Return the six lists of row 0: chunks, Gaussians, terms, owners, gone, evicted. */
function parseIds(
  data: Uint8Array, c: number, about: Header, refuse: (expected: string, got: string) => never,
): Uint32Array[] {
  if (data.length < IDS_AT) refuse(`at least ${IDS_AT} bytes of ids`, `${data.length}`);
  const head = new DataView(data.buffer, data.byteOffset, IDS_AT);
  const [g, m, d, e] = [0, 4, 8, 12].map((at) => head.getUint32(at, true)), orders = data.subarray(16, IDS_AT);
  const lengths = [c, g, m, m, d, e], n = about.gaussians, limits = [n, n, about.terms, n, n, n];
  const total = lengths.reduce((sum, length) => sum + length, 0);
  if (orders.some((order) => order > MOST_ORDER) || total > 8 * data.length) {
    refuse(`${total} ids`, `${data.length} bytes`);
  }
  const words = wordsOf(data), end = 8 * data.length, lists: Uint32Array[] = [];
  let bit = 8 * IDS_AT;
  for (let k = 0; k < 6; k++) {
    if (k !== 3 && lengths[k] > limits[k]) refuse(`at most ${limits[k]} ids`, `${lengths[k]}`);
    const values = new Float64Array(lengths[k]);
    bit = readCodes(words, bit, end, orders[k], values);
    if (bit < 0) refuse(`${lengths[k]} ids`, "another string of bits");
    const list = k === 3 ? ownersFrom(values, lists[2], about) : idsFrom(values, limits[k]);
    lists.push(list ?? refuse(`ids below ${limits[k]}`, "others"));
  }
  if (Math.ceil(bit / 8) !== data.length) refuse(`${Math.ceil(bit / 8)} bytes of ids`, `${data.length}`);
  if (peek(words, bit) !== 0) refuse("zeros after the last id", "ones");
  return lists;
}

/** Return rising ids from their distances; null unless all are below the limit. */
function idsFrom(values: Float64Array, limit: number): Uint32Array | null {
  const out = new Uint32Array(values.length);
  let at = -1;
  for (let i = 0; i < values.length; i++) {
    at += values[i] + 1;
    if (at >= limit) return null;
    out[i] = at;
  }
  return out;
}

/**
 * Return the owners of terms from how far each is from where it is expected; null unless they rise and are of the
 * scene.
 */
function ownersFrom(values: Float64Array, terms: Uint32Array, about: Header): Uint32Array | null {
  const share = Math.floor((65536 * about.gaussians) / Math.max(about.terms, 1)); // products stay below 2^53
  const out = new Uint32Array(values.length);
  let term = 0, owner = 0;
  for (let i = 0; i < values.length; i++) {
    const rest = values[i] % 2 === 0 ? values[i] / 2 : -(values[i] + 1) / 2;
    const found = owner + Math.floor(((terms[i] - term) * share) / 65536) + rest;
    if (found < owner || found >= about.gaussians) return null;
    out[i] = owner = found;
    term = terms[i];
  }
  return out;
}
