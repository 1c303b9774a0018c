// Draws what a store holds: finds colors where they are stale, projects the sorted Gaussians once each, blends their
// quads
// back to front into a half-float picture, and brings that to the canvas.
import { axesOf } from "./camera.ts";
import { harmonicRanges, PAINTS } from "./colors.ts";
import {
  colors, compile, cover, present, project, type Program, QUADS, splatFragment, splatVertex,
} from "./shaders.ts";
import type { Store } from "./store.ts";
import { GrowingTexture, ROW, takeRuns } from "./textures.ts";
import type { Camera, Paint } from "./types.ts";

/** What a picture is blended in: 32 or 16 bits of a float, or 8 bits, which clip colors above 1. */
export type Precision = "float" | "half" | "bytes";

/** How to draw. */
export interface Look {
  background: [number, number, number];
  antialiased: boolean;
  paint: Paint;
  detailed: boolean; // with terms and harmonics
}

/** Where a picture goes: null is the canvas. */
interface Destination {
  framebuffer: WebGLFramebuffer | null;
  x: number;
  y: number;
}

const CANVAS: Destination = { framebuffer: null, x: 0, y: 0 };

export class Renderer {
  readonly precision: Precision;
  readonly #gl: WebGL2RenderingContext;
  readonly #splat: Program;
  readonly #present: Program;
  readonly #order: GrowingTexture;
  readonly #shapes: GrowingTexture;
  readonly #paints: GrowingTexture;
  readonly #splats: WebGLFramebuffer;
  readonly #colored: WebGLFramebuffer;
  readonly #target: WebGLFramebuffer;
  readonly #quads: WebGLVertexArrayObject;
  readonly #indices: WebGLBuffer;
  readonly #empty: WebGLVertexArrayObject;
  #picture: WebGLTexture | null = null;
  #size = [0, 0];
  #project: Program | null = null;
  #colors: Program | null = null;
  #store: Store | null = null;
  #colorTexture: WebGLTexture | null = null;
  #isReady = false; // programs are compiled
  #seen = ""; // what all colors were found for
  count = 0; // Gaussians in the order

  constructor(gl: WebGL2RenderingContext, wanted?: Precision) {
    this.#gl = gl;
    this.precision = choosePrecision(gl, wanted);
    this.#splat = compile(gl, splatVertex, splatFragment);
    this.#present = compile(gl, cover, present);
    this.#order = new GrowingTexture(gl, "R32UI");
    this.#shapes = new GrowingTexture(gl, "RGBA32UI");
    this.#paints = new GrowingTexture(gl, "RGBA32UI");
    [this.#splats, this.#colored, this.#target] = [0, 1, 2].map(() => gl.createFramebuffer());
    [this.#quads, this.#indices] = makeQuads(gl);
    this.#empty = gl.createVertexArray();
    gl.disable(gl.DEPTH_TEST);
    gl.disable(gl.DITHER);
  }

  get bytes(): number {
    const pixel = { float: 16, half: 8, bytes: 4 }[this.precision];
    const own = this.#order.bytes + this.#shapes.bytes + this.#paints.bytes;
    return own + this.#size[0] * this.#size[1] * pixel + (this.#store?.bytes ?? 0);
  }

  /** Draw this store from now on; programs follow its variant. */
  use(store: Store): void {
    const gl = this.#gl, { layout } = store.tables;
    for (const program of [this.#project, this.#colors]) if (program) gl.deleteProgram(program.program);
    this.#project = compile(gl, cover, project(layout.hsl));
    this.#colors = compile(gl, cover, colors(layout));
    this.#store = store;
    this.#isReady = false;
    this.#colorTexture = null;
    this.#seen = "";
    this.count = 0;
  }

  /** Return whether the programs are compiled, without waiting for that where the browser can tell. */
  isReady(): boolean {
    if (this.#isReady) return true;
    const status = this.#gl.getExtension("KHR_parallel_shader_compile")?.COMPLETION_STATUS_KHR;
    const programs = [this.#colors!, this.#project!, this.#splat, this.#present];
    if (status && programs.some(({ program }) => this.#gl.getProgramParameter(program, status) === false)) return false;
    for (const program of programs) { // each is a question to the GPU, which waits for what was drawn before
      program.use();
      program.at("size");
    }
    return (this.#isReady = true);
  }

  /** Draw these places from now on, in this order. */
  setOrder(order: Uint32Array, count: number): void {
    const rows = Math.ceil(count / ROW);
    this.count = count;
    if (rows === 0) return;
    this.#order.reserve(rows * ROW, this.#store?.header.gaussians);
    this.#order.write(0, order.subarray(0, rows * ROW));
  }

  /** Draw the picture of a camera: of the background alone, and without a program, before there is anything else. */
  draw(camera: Camera, look: Look, to: Destination = CANVAS): void {
    const gl = this.#gl, store = this.#store;
    if (!store || !this.count) {
      gl.bindFramebuffer(gl.FRAMEBUFFER, to.framebuffer);
      gl.clearColor(...look.background, 1);
      gl.clear(gl.COLOR_BUFFER_BIT);
      return;
    }
    this.#resize(camera.width, camera.height);
    gl.disable(gl.BLEND);
    store.flush();
    this.#findColors(store, camera, look);
    this.#projectAll(store, camera, look);
    this.#blend(camera);
    gl.bindFramebuffer(gl.FRAMEBUFFER, to.framebuffer);
    gl.viewport(to.x, to.y, camera.width, camera.height);
    this.#present.use();
    this.#bind(this.#present, { picture: this.#picture });
    gl.uniform3fv(this.#present.at("background"), look.background);
    gl.uniform2i(this.#present.at("offset"), to.x, to.y);
    gl.bindVertexArray(this.#empty);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  /** Draw and return the pixels, RGBA, rows from the top. */
  capture(camera: Camera, look: Look): Uint8ClampedArray<ArrayBuffer> {
    const gl = this.#gl, { width, height } = camera, framebuffer = gl.createFramebuffer(), texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA8, width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
    this.draw(camera, look, { framebuffer, x: 0, y: 0 });
    const upward = new Uint8Array(4 * width * height), out = new Uint8ClampedArray(4 * width * height);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, upward);
    for (let y = 0; y < height; y++) {
      out.set(
        upward.subarray(4 * width * (height - 1 - y), 4 * width * (height - y)), 4 * width * y,
      );
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.deleteFramebuffer(framebuffer);
    gl.deleteTexture(texture);
    return out;
  }

  #resize(width: number, height: number): void {
    if (this.#picture && this.#size[0] === width && this.#size[1] === height) return;
    const gl = this.#gl;
    gl.deleteTexture(this.#picture);
    this.#picture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, this.#picture);
    gl.texStorage2D(
      gl.TEXTURE_2D, 1, { float: gl.RGBA32F, half: gl.RGBA16F, bytes: gl.RGBA8 }[this.precision], width, height,
    );
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.#target);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.#picture, 0);
    this.#size = [width, height];
  }

  /** Bind textures to units 0, 1, ... and say so to the program. */
  #bind(program: Program, textures: Record<string, WebGLTexture | null>): void {
    const gl = this.#gl;
    Object.entries(textures).forEach(([name, texture], unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.uniform1i(program.at(name), unit);
    });
    gl.activeTexture(gl.TEXTURE0 + 15); // uploads bind here
  }

  /** Find the colors of stale rows: those that arrived or got terms; all where the eye has moved and it matters. */
  #findColors(store: Store, camera: Camera, look: Look): void {
    const gl = this.#gl, program = this.#colors!, { paint, detailed } = look;
    const moves = (paint === "color" && detailed && store.viewDependent) || paint === "depth";
    const details = paint === "color" || paint === "terms" ? detailed : "";
    const seen = `${paint} ${details} ${moves ? camera.position.join(" ") : ""}`;
    if (seen !== this.#seen) for (let row = 0; row * ROW < store.count; row++) store.stale.add(row);
    this.#seen = seen;
    if (store.stale.size === 0) return;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.#colored);
    if (this.#colorTexture !== store.colors.texture) {
      this.#colorTexture = store.colors.texture;
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.#colorTexture, 0);
    }
    gl.viewport(0, 0, ROW, store.colors.rows);
    program.use();
    this.#bind(program, {
      records: store.records.texture, links: store.links.texture, chunks: store.chunks.texture,
      heads: store.heads.texture,
      terms: store.terms.texture, labels: store.labels.texture, sets: store.sets.texture, tables: store.tableTexture,
    });
    const { harmonics, gaussians, levels } = store.header;
    gl.uniform1i(program.at("mode"), PAINTS[paint]);
    gl.uniform1i(program.at("levels"), levels.length);
    gl.uniform1i(program.at("detailed"), detailed ? 1 : 0);
    gl.uniform1f(
      program.at("total"),
      paint === "arrival" ? Math.max(1, gaussians) : paint === "terms" ? 12 : 5 / (store.header.metersPerUnit || 1),
    );
    gl.uniform3fv(program.at("eye"), camera.position);
    if (harmonics) {
      const { lows, spans } = harmonicRanges(harmonics);
      gl.uniform3fv(program.at("lows"), lows);
      gl.uniform3fv(program.at("spans"), spans);
    }
    gl.bindVertexArray(this.#empty);
    gl.enable(gl.SCISSOR_TEST);
    for (const [first, last] of takeRuns(store.stale)) {
      gl.scissor(0, first, ROW, last + 1 - first);
      gl.drawArrays(gl.TRIANGLES, 0, 3);
    }
    gl.disable(gl.SCISSOR_TEST);
  }

  #projectAll(store: Store, camera: Camera, look: Look): void {
    const gl = this.#gl, program = this.#project!, rows = Math.ceil(this.count / ROW);
    const grown = this.#shapes.reserve(rows * ROW, store.header.gaussians);
    this.#paints.reserve(rows * ROW, store.header.gaussians);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.#splats);
    if (grown) {
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.#shapes.texture, 0);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT1, gl.TEXTURE_2D, this.#paints.texture, 0);
      gl.drawBuffers([gl.COLOR_ATTACHMENT0, gl.COLOR_ATTACHMENT1]);
    }
    gl.viewport(0, 0, ROW, rows);
    program.use();
    this.#bind(program, {
      order: this.#order.texture, records: store.records.texture, links: store.links.texture,
      chunks: store.chunks.texture, colors: store.colors.texture,
    });
    gl.uniform1i(program.at("count"), this.count);
    gl.uniformMatrix3fv(program.at("axes"), true, axesOf(camera));
    gl.uniform3fv(program.at("eye"), camera.position);
    gl.uniform4f(program.at("lens"), camera.fx, camera.fy, camera.cx, camera.cy);
    gl.uniform2f(program.at("size"), camera.width, camera.height);
    gl.uniform1i(program.at("antialiased"), look.antialiased ? 1 : 0);
    gl.bindVertexArray(this.#empty);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  #blend(camera: Camera): void {
    const gl = this.#gl, program = this.#splat;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.#target);
    gl.viewport(0, 0, camera.width, camera.height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    program.use();
    this.#bind(program, { shapes: this.#shapes.texture, paints: this.#paints.texture });
    gl.uniform2f(program.at("size"), camera.width, camera.height);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.bindVertexArray(this.#quads);
    gl.drawElementsInstanced(gl.TRIANGLES, 6 * QUADS, gl.UNSIGNED_SHORT, 0, Math.ceil(this.count / QUADS));
    gl.disable(gl.BLEND);
  }

  dispose(): void {
    const gl = this.#gl;
    for (const texture of [this.#order, this.#shapes, this.#paints]) texture.dispose();
    for (const framebuffer of [this.#splats, this.#colored, this.#target]) gl.deleteFramebuffer(framebuffer);
    for (const program of [
      this.#splat, this.#present, this.#project, this.#colors,
    ]) if (program) gl.deleteProgram(program.program);
    gl.deleteTexture(this.#picture);
    gl.deleteVertexArray(this.#quads);
    gl.deleteBuffer(this.#indices);
    gl.deleteVertexArray(this.#empty);
  }
}

/** Return the finest kind of picture, up to the one that is wanted, into which this GPU blends. */
export function choosePrecision(gl: WebGL2RenderingContext, wanted?: Precision): Precision {
  const full = gl.getExtension("EXT_color_buffer_float"), half = full ?? gl.getExtension("EXT_color_buffer_half_float");
  const finest = wanted ?? (isSoftware(gl) ? "float" : "half");
  if (finest === "float" && full && gl.getExtension("EXT_float_blend")) return "float";
  return finest !== "bytes" && half ? "half" : "bytes";
}

/** Return whether Chromium draws on the CPU: there a blend into half floats takes twice as long as one into floats. */
export function isSoftware(gl: WebGL2RenderingContext): boolean {
  const info = gl.getParameter(gl.RENDERER) === "WebKit WebGL" && gl.getExtension("WEBGL_debug_renderer_info");
  return !!info && /SwiftShader/.test(gl.getParameter(info.UNMASKED_RENDERER_WEBGL));
}

/** Return the corners of many quads, and the buffer of their indices: vertex 4 q + c is corner c of quad q. */
function makeQuads(gl: WebGL2RenderingContext): [WebGLVertexArrayObject, WebGLBuffer] {
  const indices = new Uint16Array(6 * QUADS);
  for (let q = 0; q < QUADS; q++) indices.set([4 * q, 4 * q + 1, 4 * q + 2, 4 * q + 2, 4 * q + 1, 4 * q + 3], 6 * q);
  const array = gl.createVertexArray(), buffer = gl.createBuffer();
  gl.bindVertexArray(array);
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, buffer);
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, indices, gl.STATIC_DRAW);
  gl.bindVertexArray(null);
  return [array, buffer];
}
