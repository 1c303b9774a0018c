// Boxes of chunks. A chunk with steps below 0 is logarithmic: its places count steps of sign(x) log(1 + |x|).

/** Return the coordinate with this symmetric logarithm. */
export function fromLog(u: number): number {
  const size = Math.abs(u);
  return Math.sign(u) * (size < 0.01 ? Math.expm1(size) : Math.exp(size) - 1); // expm1 takes four times as long
}

/** Return how many bits places along an axis have, from the `bits` of a row. */
export function bitsOf(bits: number, axis: number): number {
  return (bits >> (4 * axis)) & 15;
}

/** Write the box of a chunk, its low and then its high corner, at 6 `at`; `chunks` is as in `Batch`. */
export function writeBox(chunks: Float32Array, row: number, bits: number, boxes: Float32Array, at: number): void {
  for (let k = 0; k < 3; k++) {
    const low = chunks[8 * row + k], step = chunks[8 * row + 4 + k];
    const high = low + (2 ** bitsOf(bits, k) - 1) * Math.abs(step), curved = step < 0;
    boxes[6 * at + k] = curved ? fromLog(low) : low;
    boxes[6 * at + 3 + k] = curved ? fromLog(high) : high;
  }
}

/** Return whether a row has a box: steps all at least 0, or all below 0 and logarithms that float32 has. */
export function hasBox(chunks: Float32Array, row: number, bits: number, most: number): boolean {
  const curved = chunks[8 * row + 4] < 0;
  for (let k = 0; k < 3; k++) {
    const low = chunks[8 * row + k], step = chunks[8 * row + 4 + k], wide = bitsOf(bits, k);
    if (!Number.isFinite(low) || !Number.isFinite(step) || step < 0 !== curved || wide > most) return false;
    if (curved && Math.max(Math.abs(low), Math.abs(low - (2 ** wide - 1) * step)) > 88) return false;
  }
  return bits < 4096;
}
