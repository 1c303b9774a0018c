// The two Arrow IPC messages of the wire, without an Arrow library: the schema in WELCOME, and the frame of a BATCH.
import { ProtocolError } from "./wire.ts";

const BINARY = 4; // number of the type in Arrow's flatbuffers
const SCHEMA = 1;

/** A table of a flatbuffer whose every access is checked to lie within the bytes. */
class Table {
  readonly #data: DataView;
  readonly #at: number;

  constructor(data: DataView, at: number) {
    this.#data = data;
    this.#at = at;
  }

  /** Return where a field is, or 0 if it is absent. */
  #place(field: number): number {
    const vtable = this.#at - this.#data.getInt32(this.#at, true);
    if (4 + 2 * field >= this.#data.getUint16(vtable, true)) return 0;
    const offset = this.#data.getUint16(vtable + 4 + 2 * field, true);
    return offset === 0 ? 0 : this.#at + offset;
  }

  byte(field: number): number {
    const place = this.#place(field);
    return place === 0 ? 0 : this.#data.getUint8(place);
  }

  long(field: number): bigint {
    const place = this.#place(field);
    return place === 0 ? 0n : this.#data.getBigInt64(place, true);
  }

  #target(place: number): number {
    if (place === 0) throw new RangeError("absent");
    return place + this.#data.getUint32(place, true);
  }

  table(field: number): Table {
    return new Table(this.#data, this.#target(this.#place(field)));
  }

  tables(field: number): Table[] {
    const place = this.#place(field);
    if (place === 0) return [];
    const at = this.#target(place), count = this.#data.getUint32(at, true);
    if (4 * count > this.#data.byteLength) throw new RangeError("too many");
    return Array.from({ length: count }, (_, k) => new Table(this.#data, this.#target(at + 4 + 4 * k)));
  }

  text(field: number): string {
    const at = this.#target(this.#place(field)), length = this.#data.getUint32(at, true);
    if (at + 4 + length > this.#data.byteLength) throw new RangeError("too long");
    const bytes = new Uint8Array(this.#data.buffer, this.#data.byteOffset + at + 4, length);
    return new TextDecoder("utf-8", { fatal: true }).decode(bytes);
  }
}

/** Return the text under a key of the metadata of a schema with the one column `sections`, binary and not nullable. */
export function schemaMetadata(bytes: Uint8Array, key: string): string {
  try {
    const data = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
    const length = data.getInt32(4, true);
    if (data.getUint32(0, true) !== 0xffffffff || length + 8 !== bytes.length) throw new RangeError("another length");
    const flat = new DataView(bytes.buffer, bytes.byteOffset + 8, length);
    const message = new Table(flat, flat.getUint32(0, true));
    const schema = message.table(2), [column, ...others] = schema.tables(1);
    const binary = message.byte(1) === SCHEMA && message.long(3) === 0n && schema.byte(0) === 0 && column !== undefined;
    if (
      !binary || others.length > 0 || column.text(0) !== "sections" || column.byte(1) !== 0 || column.byte(2) !== BINARY
    ) {
      throw new RangeError("another schema");
    }
    for (const entry of schema.tables(2)) if (entry.text(0) === key) return entry.text(1);
    throw new RangeError(`no ${key}`);
  } catch (error) {
    throw new ProtocolError(
      `WELCOME: expected the schema of batches, got other bytes (${(error as Error).message.slice(0, 60)})`
    );
  }
}

// docs/streaming.md, BATCH: marker, length and metadata of a record batch of four rows, without the two numbers.
const FRAME = /* @__PURE__ */ (() => Uint8Array.from(
  ("ffffffff9800000014000000000000000c0016000600050008000c000c0000000003040018000000" + "0000000000000000" +
    "00000a0018000c00040008000a0000004c00000010000000040000000000000000000000030000000000000000000000" +
    "0000000000000000000000000000000014000000000000001800000000000000" + "0000000000000000" +
    "0000000001000000" + "0400000000000000" + "0000000000000000").match(/../g) as string[],
  (pair) => parseInt(pair, 16),
))();
const BODY_AT = 40, DATA_AT = 128, ENDS_BYTES = 24;

/** Return the four rows of the record batch that fills the bytes, as views. */
export function recordBatchRows(bytes: Uint8Array, refuse: (expected: string, got: string) => never): Uint8Array[] {
  const head = FRAME.length + ENDS_BYTES;
  if (bytes.length < head) return refuse(`at least ${head} bytes`, `${bytes.length}`);
  const data = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const ends = Array.from({ length: 5 }, (_, k) => data.getInt32(FRAME.length + 4 * k, true));
  const same = FRAME.every(
    (value, k) => (k >= BODY_AT && k < BODY_AT + 8) || (k >= DATA_AT && k < DATA_AT + 8) || bytes[k] === value,
  );
  const whole = head + ends[4] + (-ends[4] & 7) === bytes.length && data.getInt32(FRAME.length + 20, true) === 0;
  const rising = ends[0] === 0 && ends.every((end, k) => k === 0 || end >= ends[k - 1]);
  const sizes = data.getBigInt64(BODY_AT, true) === BigInt(bytes.length - FRAME.length) &&
    data.getBigInt64(DATA_AT, true) === BigInt(ends[4]);
  if (!same || !whole || !rising || !sizes || bytes.subarray(head + ends[4]).some((value) => value !== 0)) {
    return refuse("four rows that fill the message", "others");
  }
  return ends.slice(1).map((end, k) => bytes.subarray(head + ends[k], head + end));
}
