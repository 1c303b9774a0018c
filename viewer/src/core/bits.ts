// Strings of bits, from the lowest bit of each byte up, read as words of 32 bits.

/** Return the bytes as words, with zeros behind, so that reading up to 64 bits past the end is safe. */
export function wordsOf(bytes: Uint8Array): Uint32Array {
  const words = new Uint32Array((bytes.length >>> 2) + 4);
  new Uint8Array(words.buffer).set(bytes);
  return words;
}

/** Return the 32 bits from `bit` on, as an unsigned number. */
export function peek(words: Uint32Array, bit: number): number {
  const at = bit >>> 5, shift = bit & 31;
  return shift === 0 ? words[at] : ((words[at] >>> shift) | (words[at + 1] << (32 - shift))) >>> 0;
}

/** Return `width` bits (1 to 32) from `bit` on. */
export function take(words: Uint32Array, bit: number, width: number): number {
  const shift = bit & 31;
  if (shift + width <= 32) return (words[bit >>> 5] << (32 - shift - width)) >>> (32 - width);
  return width === 32 ? peek(words, bit) : (peek(words, bit) & ((1 << width) - 1)) >>> 0;
}

/** Whether an id is in a packed set. */
export function has(set: Uint32Array, id: number): boolean {
  return ((set[id >>> 5] >>> (id & 31)) & 1) === 1;
}

/** Add an id to a packed set. */
export function add(set: Uint32Array, id: number): void {
  set[id >>> 5] |= 1 << (id & 31);
}

/** Take an id out of a packed set. */
export function remove(set: Uint32Array, id: number): void {
  set[id >>> 5] &= ~(1 << (id & 31));
}

/** Return the number of set bits of a word. */
export function countOf(word: number): number {
  let v = word - ((word >>> 1) & 0x55555555);
  v = (v & 0x33333333) + ((v >>> 2) & 0x33333333);
  return Math.imul((v + (v >>> 4)) & 0x0f0f0f0f, 0x01010101) >>> 24;
}

/**
 * Read values in exponential Golomb codes of an order until `out` is full.
 *
 * Returns the bit after the last, or -1 if the bits before `end` are no such values.
 */
export function readCodes(words: Uint32Array, from: number, end: number, order: number, out: Float64Array): number {
  let bit = from;
  for (let i = 0; i < out.length; i++) {
    let word = peek(words, bit), zeros = 0;
    if (word === 0) {
      zeros = 32;
      word = peek(words, Math.min(bit + 32, end));
      if ((word & 1) === 0) return -1;
    } else {
      zeros = 31 - Math.clz32(word & -word);
    }
    const count = order + zeros;
    bit += zeros + 1;
    if (count > 33 || bit + count > end) return -1;
    let low = count === 0 ? 0 : take(words, bit, Math.min(count, 32));
    if (count === 33) low += (peek(words, bit + 32) & 1) * 2 ** 32;
    out[i] = low + 2 ** count - 2 ** order;
    bit += count;
  }
  return bit;
}
