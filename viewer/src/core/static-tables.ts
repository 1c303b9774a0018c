// Tables of a static scene: compressed columns of numbers (docs/static.md).

/** Return what is said of a file that makes no sense. */
export const damaged = (where: string): Error => new Error(`${where}: damaged; export the scene again`);

/** Return the content of a zlib stream of at most `most` bytes. */
export async function inflate(data: Uint8Array, most: number, where: string): Promise<Uint8Array> {
  const out = new Uint8Array(Math.min(most, 1100 * data.length + 100)); // zlib gains no more
  let at = 0;
  // A Blob in place of the writer would send the bytes through the browser's own process, which takes ten times as long.
  const stream = new DecompressionStream("deflate"), writer = stream.writable.getWriter();
  for (const written of [writer.write(data as Uint8Array<ArrayBuffer>), writer.close()]) written.catch(() => undefined);
  const reader = stream.readable.getReader();
  for (;;) {
    const { done, value } = await reader.read().catch(() => { throw damaged(where); });
    if (done) return out.subarray(0, at);
    if (at + value.length > out.length) throw damaged(where);
    out.set(value, at);
    at += value.length;
  }
}

/** Reads columns one after the other. */
export class Columns {
  private at = 0;

  constructor(private readonly data: Uint8Array, private readonly count: number) {}

  /** Return the next column of numbers of `width` bytes. */
  next(width: number, count = this.count): Uint32Array {
    const out = new Uint32Array(count);
    for (let k = 0; k < width; k++) for (let i = 0; i < count; i++) out[i] |= this.data[this.at++] << (8 * k);
    return out;
  }

  /** Return the next column of folded differences, summed. */
  sums(width: number, count = this.count): Int32Array {
    let last = 0;
    return Int32Array.from(this.next(width, count), (v) => (last += (v >>> 1) ^ -(v & 1)));
  }
}
