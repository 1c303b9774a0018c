// Records of Gaussians and terms as the wire has them: symbols of tables and raw bits (docs/streaming.md, "Coding").
import { readCodes, wordsOf } from "./bits.ts";
import { bitsOf } from "./boxes.ts";
import type { Chunks } from "./chunks.ts";
import { recordLayout, termWidths } from "./tables.ts";
import type { Code, ColorTables, SymbolTable } from "./types.ts";
import { ProtocolError } from "./wire.ts";

const LEAST = 65536, SLOTS = 4096, MOST_LEVEL = 49, TURNS = 8, COLOR = 35, FUNCTION = 69;

const log = (value: number) => Math.round(64 * Math.log2(value));
const LOGS = /* @__PURE__ */ Int16Array.from({ length: 256 }, (_, i) => log(Math.max(i, 1)));
const SUMS = /* @__PURE__ */ Int16Array.from({ length: 512 }, (_, i) => log(1 + 2 ** (-i / 64)));
const clamp = (value: number, low: number, high: number) => Math.min(Math.max(value, low), high);
const sum = (a: number, b: number) => Math.max(a, b) + SUMS[Math.min(Math.abs(a - b), 511)];

/** Return the code that `text`, the `code` of WELCOME, says; raise ProtocolError for other text. */
export function codeOf(text: string, colors: ColorTables, steps: Code["steps"]): Code {
  const refuse = (): never => {
    throw new ProtocolError("WELCOME: expected tables of symbols, got other text");
  };
  let bytes = new Uint8Array(0);
  try {
    bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  } catch {
    refuse();
  }
  const words = wordsOf(bytes);
  let bit = 0;
  const read = (order: number, count: number) => {
    const out = new Float64Array(count);
    bit = readCodes(words, bit, 8 * bytes.length, order, out);
    return bit < 0 ? refuse() : out;
  };
  const tables = sizesOf(colors).map((size) => {
    const [order] = read(0, 1);
    if (order === 0) return null;
    const [first, more] = read(0, 2), weights = new Float64Array(size);
    if (order > 9 || first + more >= size) refuse();
    let level = 0;
    read(order - 1, more + 1).forEach((value, i) => {
      if (value === 0) return;
      level += value % 2 ? (value - 1) / 2 : -value / 2;
      if (level < 1 || level > MOST_LEVEL) refuse();
      weights[first + i] = (4 + ((level - 1) & 3)) << ((level - 1) >> 2);
    });
    return tableOf(weights);
  });
  if (Math.ceil(bit / 8) !== bytes.length) refuse();
  return { colors, tables, steps };
}

/** Return the number of symbols of each table. */
function sizesOf(colors: ColorTables): number[] {
  const { rotation, scale } = recordLayout(colors.variant), [f, polar, azimuth, decay, strength] = termWidths(colors);
  const many = (count: number, bits: number) => Array<number>(count).fill(2 ** bits);
  return [
    256, 6, ...many(3, scale), ...many(6, 6), ...many(3 * TURNS, rotation), ...many(34, 8),
    2 ** f, ...many(9, Math.min(strength, 6)), ...many(8, Math.min(decay, 6)), 2 ** Math.min(polar, 6),
    ...many(8, Math.min(azimuth, 7)), ...many(29, Math.min(strength, 6)),
  ];
}

/** Return the table of symbols with these weights: each has one slot, and of the rest its share. */
function tableOf(weights: Float64Array): SymbolTable | null {
  const total = weights.reduce((a, b) => a + b, 0), some = weights.filter((weight) => weight > 0).length;
  if (total === 0) return null;
  const slots = new Uint16Array(SLOTS), spans = new Uint32Array(weights.length);
  let before = 0, seen = 0, start = 0;
  weights.forEach((weight, symbol) => {
    before += weight;
    seen += weight > 0 ? 1 : 0;
    const end = Math.floor((before * (SLOTS - some)) / total) + seen;
    slots.fill(symbol, start, end);
    spans[symbol] = start + (end - start) * 65536;
    start = end;
  });
  return { slots, spans };
}

/** Reads symbols and bits; what is missing reads as zeros. */
class Reader {
  readonly #words: Uint16Array;
  readonly #tables: (SymbolTable | null)[];
  readonly #states = new Uint32Array(2); // operations use one and the other in turn
  #turn = 0;
  #at = 4;

  constructor(bytes: Uint8Array, tables: (SymbolTable | null)[]) {
    this.#words = new Uint16Array(Math.max(Math.ceil(bytes.length / 2), 4));
    new Uint8Array(this.#words.buffer).set(bytes);
    this.#tables = tables;
    for (const k of [0, 1]) this.#states[k] = this.#words[2 * k] | (this.#words[2 * k + 1] << 16);
  }

  symbol(table: number): number {
    const found = this.#tables[table], state = this.#states[this.#turn];
    if (found === null) {
      this.#at = Infinity;
      return 0;
    }
    const slot = state & (SLOTS - 1), symbol = found.slots[slot], span = found.spans[symbol];
    this.#next(Math.imul(span >>> 16, state >>> 12) + slot - (span & 65535));
    return symbol;
  }

  bits(count: number): number {
    if (count === 0) return 0;
    const state = this.#states[this.#turn];
    this.#next(state >>> count);
    return state & ((1 << count) - 1);
  }

  /** Return a field: a symbol of its upper `most` bits, and the bits below. */
  field(table: number, bits: number, most: number): number {
    const rest = Math.max(bits - most, 0), upper = this.symbol(table);
    return (upper << rest) | this.bits(rest);
  }

  get isPastEnd(): boolean {
    return this.#at > this.#words.length;
  }

  get isAtEnd(): boolean {
    return this.#at === this.#words.length && this.#states.every((state) => state === LEAST);
  }

  #next(state: number): void {
    const states = this.#states, turn = this.#turn;
    states[turn] = state;
    if (states[turn] < LEAST) states[turn] = (states[turn] << 16) | this.#words[this.#at++];
    this.#turn = 1 - turn;
  }
}

/** Add a value of at most 32 bits to a string of bits, at a place where it is zero. */
function put(words: Uint32Array, bit: number, value: number): void {
  const shift = bit & 31;
  words[bit >>> 5] |= value << shift;
  if (shift > 0) words[(bit >>> 5) + 1] |= value >>> (32 - shift);
}

/**
 * Return records of Gaussians, four words each; null unless the bytes are such.
 *
 * `rows` and `table` are as in `Batch`; ids rise.
 */
export function readRecords(
  bytes: Uint8Array, ids: Uint32Array, rows: Uint32Array, { table: chunks, bits }: Pick<Chunks, "table" | "bits">,
  { colors, tables, steps }: Code,
): Uint32Array | null {
  const { position, rotation, scale, from, colorScale } = recordLayout(colors.variant);
  if (bytes.length % 2 || (bytes.length > 0) !== (ids.length > 0)) return null;
  const reader = new Reader(bytes, tables), out = new Uint32Array(4 * ids.length);
  const lead = colorScale ? 3 : 2, mask = 2 ** scale - 1, half = 2 ** (rotation - 1) - 1;
  const exponents = new Uint32Array(chunks.buffer, chunks.byteOffset, chunks.length), s = new Int32Array(3);
  const wide = new Int32Array(3), coarse = new Int32Array(3); // of the row: bits of places, logarithms of steps
  let strength = 0;
  for (let i = 0; i < ids.length; i++) {
    if (reader.isPastEnd) return null;
    const row = rows[i], low = chunks[8 * row + 3], stride = chunks[8 * row + 7];
    const opacity = reader.symbol(0), order = reader.symbol(1), middle = reader.symbol(2), smallest = reader.symbol(3);
    const long = middle * stride, short = smallest * stride;
    const weight = LOGS[opacity] + sum(sum(-long, -short), -long - short);
    let top = 0;
    if (i === 0 || row !== rows[i - 1]) {
      top = reader.symbol(4);
      for (let k = 0; k < 3; k++) {
        wide[k] = bitsOf(bits[row], k);
        coarse[k] = logOfStep(exponents[8 * row + 4 + k], chunks[8 * row + k], chunks[8 * row + 4 + k], wide[k]);
      }
    } else {
      top = reader.symbol(5 + Math.min(31 - Math.clz32(ids[i] - ids[i - 1]), 5));
      const expected = Math.floor((((strength - weight) >> 1) - low) / stride);
      top = top === 63 ? reader.bits(scale) : (clamp(expected, 0, mask) + top - 47) & mask;
    }
    const size = low + top * stride, largest = order >> 1, a = largest === 0 ? 1 : 0, b = largest === 2 ? 1 : 2;
    strength = 2 * size + weight;
    s[largest] = top;
    s[order & 1 ? b : a] = (top - middle) & mask;
    s[order & 1 ? a : b] = (top - smallest) & mask;
    const at = 128 * i, width = position + rotation + scale;
    const turn = steps ? clamp((steps.turn - Math.floor((2 * size + long) / 4)) >> 6, 0, TURNS - 1) : 0;
    for (let k = 0; k < 3; k++) {
      const q = (((reader.symbol(11 + TURNS * k + turn) - half) << turn) + half) & (2 * half + 1);
      put(out, at + from + k * width + position, q | (s[k] << rotation));
    }
    const first = reader.symbol(COLOR), base = colorScale ? 0 : first;
    const second = reader.symbol(COLOR + 1 + (first >> 5));
    const third = reader.symbol(COLOR + 9 + (colorScale ? second >> 4 : clamp(((second << 24) >> 26), -8, 8) + 8));
    put(out, at, opacity | (((second + base) & 255) << 8));
    put(out, at + 8 * lead, first);
    put(out, at + 8 * (5 - lead), (third + base) & 255);
    if (colorScale) put(out, at + 32, reader.symbol(COLOR + 26 + (first >> 5)));
    const limit = steps ? Math.min(steps.place - (long >> 1) - LOGS[opacity], size - long) >> 6 : 0;
    for (let k = 0; k < 3; k++) {
      const gone = steps ? clamp(limit - coarse[k], 0, wide[k]) : 0;
      put(out, at + from + k * width, reader.bits(wide[k] - gone) << gone);
    }
  }
  return ids.length === 0 || reader.isAtEnd ? out : null;
}

/** Return the binary logarithm of the largest step that places take, rounded up; `bits` are those of `step`. */
function logOfStep(bits: number, low: number, step: number, wide: number): number {
  const log2 = ((bits >>> 23) & 255) - 127 + (bits & 0x7fffff ? 1 : 0);
  const high = low - (2 ** wide - 1) * step; // of a logarithmic chunk, whose steps stretch
  return log2 + (step < 0 ? Math.ceil(Math.max(Math.abs(low), Math.abs(high)) * Math.LOG2E) : 0);
}

/** Return records of terms, two words each; null unless the bytes are such. Owners never fall. */
export function readTerms(bytes: Uint8Array, owners: Uint32Array, { colors, tables }: Code): Uint32Array | null {
  const [f, p, a, d, n, ...others] = termWidths(colors), out = new Uint32Array(2 * owners.length);
  if (bytes.length % 2 || (bytes.length > 0) !== (owners.length > 0)) return null;
  const reader = new Reader(bytes, tables), mask = 2 ** n - 1;
  const six = (value: number, bits: number) => (bits > 6 ? value >> (bits - 6) : value << (6 - bits));
  const LEAD = FUNCTION + 1, DECAY = LEAD + 9, POLAR = DECAY + 8, AZIMUTH = POLAR + 1, OTHER = AZIMUTH + 8;
  let upper = 0;
  for (let i = 0; i < owners.length; i++) {
    if (reader.isPastEnd) return null;
    const again = i > 0 && owners[i] === owners[i - 1], fields = [f ? reader.symbol(FUNCTION) : 0];
    const lead = reader.field(again ? LEAD + 1 + (upper >> 3) : LEAD, n, 6);
    upper = six(lead, n);
    fields[3] = reader.field(DECAY + (upper >> 3), d, 6);
    fields[1] = reader.field(POLAR, p, 6);
    fields[2] = reader.field(AZIMUTH + (six(fields[1], p) >> 3), a, 7);
    fields[4] = lead;
    if (others.length > 0) {
      const other = reader.field(OTHER + (upper >> 2), n, 6), bits = Math.min(n, 6);
      const near = clamp(((other >> (n - bits)) << (32 - bits)) >> (32 - bits), -6, 6);
      const last = reader.field(OTHER + 22 + near, n, 6);
      fields.splice(4, 1, (other + lead) & mask, lead, (last + lead) & mask);
    }
    let bit = 64 * i;
    [f, p, a, d, n, ...others].forEach((width, k) => {
      put(out, bit, fields[k]);
      bit += width;
    });
  }
  return owners.length === 0 || reader.isAtEnd ? out : null;
}
