// A texture of unsigned integers that is filled from its first texel on and grows, on the GPU, without a copy on the
// CPU.

type Format = "R32UI" | "RG32UI" | "RGBA32UI";

/** Texels in a row of every growing texture. */
export const ROW = 2048;

const LEAST_ROWS = 64; // of a texture that is in use

const LENGTHS: Record<Format, number> = { R32UI: 1, RG32UI: 2, RGBA32UI: 4 };

export class GrowingTexture {
  readonly #gl: WebGL2RenderingContext;
  readonly #format: Format;
  #texture: WebGLTexture | null = null;
  #rows = 0;

  constructor(gl: WebGL2RenderingContext, format: Format) {
    this.#gl = gl;
    this.#format = format;
  }

  get texture(): WebGLTexture | null { return this.#texture; }
  get rows(): number { return this.#rows; }
  get bytes(): number { return this.#rows * ROW * 4 * LENGTHS[this.#format]; }

  /**
   * Make room for `texels`; `most` bounds how far ahead it grows. Returns whether the texture is another one now: never
   * one of a lost context.
   */
  reserve(texels: number, most = Infinity): boolean {
    const needed = Math.max(1, Math.ceil(texels / ROW));
    const gl = this.#gl;
    if (needed <= this.#rows || gl.isContextLost()) return false;
    const limit = gl.getParameter(gl.MAX_TEXTURE_SIZE) as number;
    if (needed > limit) {
      throw new Error(`this device draws at most ${limit * ROW} Gaussians or terms of a scene, got ${texels}`);
    }
    const ahead = Math.max(this.#rows * 2, needed > 1 ? LEAST_ROWS : 1);
    const rows = Math.min(limit, Math.max(needed, Math.min(ahead, Math.ceil(most / ROW))));
    const texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl[this.#format], ROW, rows);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    if (this.#texture) {
      const framebuffer = gl.createFramebuffer();
      gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.#texture, 0);
      gl.copyTexSubImage2D(gl.TEXTURE_2D, 0, 0, 0, 0, 0, ROW, this.#rows);
      gl.bindFramebuffer(gl.FRAMEBUFFER, null);
      gl.deleteFramebuffer(framebuffer);
      gl.deleteTexture(this.#texture);
    }
    this.#texture = texture;
    this.#rows = rows;
    return true;
  }

  /** Write `data` from texel `first` on; there must be room. */
  write(first: number, data: Uint32Array): void {
    const gl = this.#gl, length = LENGTHS[this.#format];
    const format = length === 1 ? gl.RED_INTEGER : length === 2 ? gl.RG_INTEGER : gl.RGBA_INTEGER;
    gl.bindTexture(gl.TEXTURE_2D, this.#texture);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 4);
    let from = 0;
    const count = data.length / length;
    while (from < count) {
      const x = (first + from) % ROW, y = Math.floor((first + from) / ROW);
      const whole = x === 0 && count - from >= ROW;
      const wide = whole ? ROW : Math.min(ROW - x, count - from), high = whole ? Math.floor((count - from) / ROW) : 1;
      gl.texSubImage2D(gl.TEXTURE_2D, 0, x, y, wide, high, format, gl.UNSIGNED_INT, data, from * length);
      from += wide * high;
    }
  }

  dispose(): void {
    this.#gl.deleteTexture(this.#texture);
    this.#texture = null;
    this.#rows = 0;
  }
}

/** Return the runs [first, last] of marked rows, and clear the marks; many runs become one. */
export function takeRuns(marks: Set<number>, mostRuns = 32): [number, number][] {
  const rows = [...marks].sort((a, b) => a - b), runs: [number, number][] = [];
  marks.clear();
  for (const row of rows) {
    const last = runs[runs.length - 1];
    if (last && row <= last[1] + 1) last[1] = row;
    else runs.push([row, row]);
  }
  return runs.length > mostRuns ? [[rows[0], rows[rows.length - 1]]] : runs;
}
