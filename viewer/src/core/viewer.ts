// A canvas and a source make a picture: appends what arrives, has it sorted, draws when something has changed.
import { angleBetween, cameraOf, sameCamera, viewOf } from "./camera.ts";
import { isSmall, memoryOfDevice } from "./device.ts";
import { Intake } from "./intake.ts";
import type { Pick } from "./picking.ts";
import { choosePrecision, isSoftware, type Look, type Precision, Renderer } from "./renderer.ts";
import { Sorter } from "./sorter.ts";
import type { Region } from "./sorting.ts";
import { bytesOfGaussian, Store } from "./store.ts";
import { ROW } from "./textures.ts";
import type { Batch, Camera, Header, Marks, Paint, Pose, Source, SourceState, Traffic } from "./types.ts";
import type { Eye, Statistics, ViewerEvent, ViewerOptions } from "./viewer-types.ts";
import type { EyeView, XrSession } from "./xr.ts";

/** Raised where the browser cannot draw at all. */
export class UnsupportedError extends Error {}

/** What an order of Gaussians is for. */
interface Order {
  camera: Camera;
  version: number; // of the data
  region: Region;
}

// bytes for each Gaussian to draw it, with its share of a chunk, for each term, and beside them
const DRAWN = 44, TERM = 16, BESIDE = 2 ** 19;
// pause after a picture, in times of what it took, and where the CPU draws; between looks whether it is done
const REST = 2, REST_OF_CPU = 5, LOOK_MS = 20;
const START: Eye = { position: [0, 0, 0], rotation: [1, 0, 0, 0], fovY: Math.PI / 3 };

/** Shows what a source gives on a canvas. Events of `ViewerEvent` say what has changed. */
export class Viewer extends EventTarget {
  readonly canvas: HTMLCanvasElement;
  /** Whether nothing is drawn until all of the scene is here: something else is shown meanwhile. */
  patient: boolean;
  readonly #gl: WebGL2RenderingContext;
  readonly #options: ViewerOptions;
  readonly #sorter: Sorter;
  readonly #look: Look;
  readonly #resizes: ResizeObserver;
  readonly #intake = new Intake((batch) => this.#takeBatch(batch));
  #renderer: Renderer;
  #store: Store | null = null;
  #source: Source | null = null;
  #header: Header | null = null;
  #state: SourceState = { kind: "connecting" };
  #eye: Eye;
  #fixed: Camera | null = null;
  #levels: boolean[] = [];
  #most: { gaussians: number; ratio: number };
  #lost = false;
  #immersed = false;
  #marks: Marks = {};
  #waiting: Batch[] | null = null; // what arrived while the GPU is lost or filled anew
  #room = 0; // Gaussians that the budget holds, each with its share of the terms
  #share = 0;
  #dirty = true;
  #version = 0; // of the data
  #sorted: Order | null = null; // what the last order is for
  #asked: Order | null = null;
  #pause = 0; // a timer: what has come of late is drawn when it ends
  #fence: WebGLSync | null = null; // the GPU has drawn the last picture
  #until = 0; // when the next one may be
  #frame = 0;
  #recent: number[] = []; // times of the last frames
  #settled: (() => void)[] = [];
  #opened = 0;
  #replaced = 0; // since the last compaction
  readonly #sets = new Map<number, Uint8Array>(); // of harmonics, by the number of the first
  readonly #figures = {
    frame: 0, sort: 0, append: 0, dropped: 0, replaced: 0, frames: 0, first: null as number | null,
  };
  #traffic: Traffic = { bytes: 0, rate: 0, gaussians: 0, terms: 0, replaced: 0, reconnects: 0 };

  /** Draw on a canvas. Throws `UnsupportedError` where there is no WebGL2. */
  constructor(canvas: HTMLCanvasElement, options: ViewerOptions = {}) {
    super();
    this.canvas = canvas;
    this.#options = options;
    this.patient = options.patient ?? false;
    this.#eye = options.camera ?? START;
    this.#most = { gaussians: options.budget ?? Infinity, ratio: options.maxPixelRatio ?? Infinity };
    this.#sorter = new Sorter(options.sortWorker); // its script comes while the browser makes a context
    const gl = canvas.getContext(
      "webgl2", { alpha: false, antialias: false, depth: false, stencil: false, powerPreference: "high-performance" },
    );
    if (!gl) {
      this.#sorter.close();
      throw new UnsupportedError("This browser offers no WebGL2, or graphics are off.");
    }
    this.#gl = gl;
    this.#renderer = new Renderer(gl, options.precision);
    this.#look = {
      background: options.background ?? [0, 0, 0], antialiased: options.antialiased ?? false, paint: "color",
      detailed: true,
    };
    this.#sorter.onOrder = ({ order, count, milliseconds }) => this.#takeOrder(order, count, milliseconds);
    this.#sorter.onRenumbered = (slots) => this.#beginStore(slots);
    this.#sorter.onContent = (batch) => this.#store?.append(batch, true);
    this.#sorter.onComplete = () => this.#finishStore();
    this.#sorter.onFailure = (message) => this.#say("problem", message);
    canvas.addEventListener("webglcontextlost", this.#lose);
    canvas.addEventListener("webglcontextrestored", this.#restore);
    this.#resizes = new ResizeObserver(() => this.resize());
    this.#resizes.observe(canvas);
    if (options.source) this.open(options.source);
  }

  /** Show what a source gives, instead of what was shown. */
  open(source: Source): void {
    this.#source?.close();
    this.#intake.clear();
    this.#source = source;
    this.#opened = performance.now();
    this.#figures.first = null;
    source.start({
      header: (header, fresh) => { if (source === this.#source) this.#takeHeader(header, fresh); },
      batch: (batch) => { if (source === this.#source) this.#intake.add(batch); },
      sets: (first, sets) => { if (source === this.#source) this.#takeSets(first, sets); },
      state: (state) => {
        if (source !== this.#source) return;
        if (state.kind === "complete" && this.#state.kind !== "complete") this.#endPause();
        this.#state = state;
        this.#say("state");
      },
      traffic: (traffic) => {
        if (source !== this.#source) return;
        this.#traffic = traffic;
        this.#say("traffic");
      },
    });
    source.view(viewOf(this.lens));
    source.pose(this.#pose());
  }

  /** Stop everything and free what is held. */
  dispose(): void {
    this.#lost = true; // what is still on its way draws nothing
    cancelAnimationFrame(this.#frame);
    clearTimeout(this.#pause);
    this.#source?.close();
    this.#source = null;
    this.#intake.clear();
    this.#sorter.close();
    this.#resizes.disconnect();
    this.canvas.removeEventListener("webglcontextlost", this.#lose);
    this.canvas.removeEventListener("webglcontextrestored", this.#restore);
    this.#store?.dispose();
    this.#renderer.dispose();
  }

  /** What is known of the scene, null before the source has said it. */
  get header(): Header | null { return this.#header; }

  /** How the source fares. */
  get state(): SourceState { return this.#state; }

  /** Where the eye is and how wide it sees; setting it draws. */
  get camera(): Eye { return this.#eye; }

  set camera(eye: Eye) {
    const wide = eye.fovY !== this.#eye.fovY || this.#fixed;
    this.#eye = eye;
    this.#fixed = null;
    if (wide) this.#source?.view(viewOf(this.lens));
    this.#source?.pose(this.#pose());
    this.redraw();
  }

  /** The exact camera of the canvas. Set one to draw it whatever the size of the canvas, until `camera` is set. */
  get lens(): Camera {
    if (this.#fixed) return this.#fixed;
    const { clientWidth, clientHeight } = this.canvas, ratio = this.pixelRatio;
    return cameraOf(
      this.#eye, Math.max(1, Math.round(clientWidth * ratio)), Math.max(1, Math.round(clientHeight * ratio)),
      this.#eye.fovY,
    );
  }

  set lens(lens: Camera) {
    this.#fixed = lens;
    this.#eye = { position: lens.position, rotation: lens.rotation, fovY: 2 * Math.atan(lens.height / 2 / lens.fy) };
    this.#source?.view(viewOf(lens));
    this.#source?.pose(this.#pose());
    this.redraw();
  }

  #pose(): Pose {
    return { position: this.#eye.position, rotation: this.#eye.rotation };
  }

  /** Pixels of the picture for each CSS pixel. */
  get pixelRatio(): number {
    const { ratio } = this.#most;
    return Math.min(globalThis.devicePixelRatio || 1, ratio < Infinity ? ratio : isSmall() ? 1.5 : 2);
  }

  /** Most pixels for each CSS pixel; Infinity leaves it to the device: 2, or 1.5 on small ones. */
  get maxPixelRatio(): number { return this.#most.ratio; }
  set maxPixelRatio(ratio: number) {
    if (ratio === this.#most.ratio) return;
    this.#most.ratio = ratio;
    this.resize();
  }

  /**
   * Most Gaussians that are drawn in a picture, Infinity for all: where more are in view, those with the largest
   * estimated share of it.
   */
  get budget(): number { return this.#most.gaussians; }
  set budget(gaussians: number) {
    if (gaussians === this.#most.gaussians) return;
    this.#most.gaussians = gaussians;
    this.redraw();
  }

  /** What the colors show. */
  get paint(): Paint { return this.#look.paint; }
  set paint(paint: Paint) { this.#look.paint = paint; this.#mark(); }

  /** What the paints `visibility` and `weight` show: a byte for each Gaussian, by its id; set for each scene anew. */
  get marks(): Marks { return this.#marks; }
  set marks(marks: Marks) { this.#marks = marks; this.#mark(); }

  /** Whether terms and spherical harmonics are shown. */
  get termsShown(): boolean { return this.#look.detailed; }
  set termsShown(shown: boolean) { this.#look.detailed = shown; this.redraw(); }

  /** What lies behind the scene: RGB from 0 to 1. */
  get background(): [number, number, number] { return this.#look.background; }
  set background(background: [number, number, number]) { this.#look.background = background; this.redraw(); }

  /** Whether opacities are lowered to make up for the blur of 0.3 square pixels. */
  get antialiased(): boolean { return this.#look.antialiased; }
  set antialiased(antialiased: boolean) { this.#look.antialiased = antialiased; this.redraw(); }

  /** Which levels are drawn, lowest first: a Gaussian is, if one of its levels is. Those not named are. */
  get levelsShown(): boolean[] { return this.#levels; }
  set levelsShown(shown: boolean[]) { this.#levels = shown; this.redraw(); }

  /** Figures of this moment. */
  get statistics(): Statistics {
    const now = performance.now(), figures = this.#figures, { bytes, rate, reconnects } = this.#traffic;
    this.#recent = this.#recent.filter((time) => now - time < 1000);
    return {
      fps: this.#recent.length, frames: figures.frames, frameMilliseconds: figures.frame,
      sortMilliseconds: figures.sort, appendMilliseconds: figures.append, gaussians: this.#store?.count ?? 0,
      drawn: this.#renderer.count, replaced: figures.replaced, terms: this.#store?.termCount ?? 0,
      dropped: figures.dropped, gpuBytes: this.#renderer.bytes, firstImageSeconds: figures.first,
      precision: this.#renderer.precision, state: this.#state, bytes, rate, reconnects,
    };
  }

  /** Draw again with the next frame. */
  redraw(): void {
    this.#dirty = true;
    this.#request();
  }

  /** Resolve when the canvas shows everything that has arrived, sorted for its camera. */
  settled(): Promise<void> {
    this.#request();
    return new Promise((resolve) => this.#settled.push(resolve));
  }

  /** Return what lies under a point of the canvas, in CSS pixels from its upper left corner. */
  pick(x: number, y: number): Promise<Pick | null> {
    const lens = this.lens, toPixels = lens.width / (this.canvas.clientWidth || lens.width);
    return this.#sorter.pick(lens, Math.floor(x * toPixels) + 0.5, Math.floor(y * toPixels) + 0.5, this.#mask());
  }

  /** Return the pixels of a camera, RGBA from the upper left corner; those of the canvas by default. */
  async capture(lens: Camera = this.lens): Promise<ImageData> {
    const before = this.#fixed;
    this.#fixed = lens;
    this.redraw();
    try {
      await this.settled();
      return new ImageData(this.#renderer.capture(lens, this.#look), lens.width, lens.height);
    } finally {
      this.#fixed = before;
      this.redraw();
    }
  }

  /** Return a picture as PNG, of the size of the canvas or another. */
  async screenshot(width?: number, height?: number): Promise<Blob> {
    const image = await this.capture(width && height ? cameraOf(this.#eye, width, height, this.#eye.fovY) : this.lens);
    const canvas = document.createElement("canvas");
    canvas.width = image.width;
    canvas.height = image.height;
    canvas.getContext("2d")?.putImageData(image, 0, 0);
    return new Promise((resolve, reject) => {
      canvas.toBlob(
        (blob) => (blob ? resolve(blob) : reject(new Error("No PNG could be made."))),
        "image/png",
      );
    });
  }

  /** Take the size of the canvas on the page; happens by itself when it changes. */
  resize(): void {
    if (!this.#fixed) this.#source?.view(viewOf(this.lens));
    this.redraw();
  }

  /** Show the scene in an immersive session, from where the camera is, until the session ends. */
  async enterXr(session: XrSession): Promise<void> {
    const { up, metersPerUnit } = this.#header ?? { up: [0, 1, 0], metersPerUnit: 1 };
    // a module of its own, as few visitors have a headset
    const { frameAt, runSession } = await import(new URL("xr.js", import.meta.url).href) as typeof import("./xr.ts");
    this.#immersed = true;
    try {
      await runSession(session, this.#gl, frameAt(this.#pose(), up, metersPerUnit), (eyes) => this.#drawEyes(eyes));
    } finally {
      this.#immersed = false;
      this.redraw();
    }
  }

  #drawEyes(eyes: EyeView[]): void {
    if (this.#lost) return;
    const [{ lens }] = eyes;
    this.#source?.pose({ position: lens.position, rotation: lens.rotation });
    this.#order(lens, 0.3);
    for (const eye of eyes) this.#renderer.draw(eye.lens, this.#look, eye);
    this.#count(performance.now());
  }

  #say(name: ViewerEvent, detail?: string): void {
    this.dispatchEvent(new CustomEvent(name, { detail }));
  }

  /** Levels that are drawn, one bit each. */
  #mask(): number {
    return this.#levels.reduce((mask, shown, k) => (shown ? mask : mask & ~(1 << k)), 0xffff);
  }

  #takeHeader(header: Header, fresh: boolean): void {
    this.#header = header;
    this.#look.antialiased = this.#options.antialiased ?? header.antialiased;
    if (fresh || !this.#store) {
      this.#intake.clear();
      this.#marks = {};
      this.#sets.clear();
      this.#sorter.reset(header);
      this.#figures.dropped = this.#figures.replaced = this.#replaced = 0;
      this.#waiting = null;
      this.#version += 1;
      if (this.#isLost()) this.#waiting = [];
      else {
        this.#beginStore(null);
        this.#finishStore();
      }
    }
    this.#say("header");
  }

  #takeBatch(batch: Batch): void {
    if (this.#isLost()) this.#waiting ??= [];
    if (this.#waiting) {
      this.#waiting.push(batch);
      return;
    }
    const begin = performance.now(), store = this.#store;
    const fitting = this.#trim(batch);
    store?.append(fitting);
    this.#replaced += batch.gone.length;
    this.#figures.replaced += batch.gone.length;
    this.#version += 1;
    this.#sorter.append(fitting);
    this.#figures.append = performance.now() - begin;
    if (store && this.#replaced > 100_000 && this.#replaced > store.count * 0.35) this.#refill();
    this.#request();
  }

  /** Keep sets of harmonics, as the GPU may lose them, and hand them on. */
  #takeSets(first: number, sets: Uint8Array): void {
    this.#sets.set(first, sets);
    if (this.#isLost()) return;
    this.#store?.addSets(first, sets);
    this.#version += 1;
    this.#request();
  }

  /** Return the batch without its Gaussians, or its terms, if they do not fit into the budget. */
  #trim(batch: Batch): Batch {
    const store = this.#store, count = batch.ids.length, none = new Uint32Array(0);
    if (!store) return batch;
    const fitting = store.termCount + batch.owners.length <= this.#room * this.#share ? batch
      : { ...batch, terms: none, owners: none };
    if (count === 0 || store.count + count <= Math.min(store.most, this.#room)) return fitting;
    if (this.#figures.dropped === 0) {
      this.#say(
        "problem",
        `This device's memory holds ${store.count.toLocaleString("en")} Gaussians of this scene;` +
          " the others are left out.",
      );
    }
    this.#figures.dropped += count;
    return { ...fitting, ids: none, records: none, rows: none, labels: null };
  }

  /** Return whether the GPU has lost all; the event that says so may come later. */
  #isLost(): boolean {
    return this.#lost || this.#gl.isContextLost();
  }

  /** Bring the marks of the paint to the GPU. */
  #mark(): void {
    const marks = this.#marks[this.paint];
    if (marks && this.#store && this.#store.marks !== marks && !this.#isLost()) this.#refill();
    this.redraw();
  }

  /** Fill the GPU anew from what the Worker holds: after a lost context, or to close the gaps of what was replaced. */
  #refill(): void {
    this.#waiting ??= [];
    this.#replaced = 0;
    this.#sorter.content();
  }

  #beginStore(slots: Uint32Array | null): void {
    if (!this.#header || this.#isLost()) return;
    this.#store?.dispose();
    this.#store = new Store(this.#gl, this.#fitted(this.#header));
    this.#store.slots = slots;
    this.#store.marks = this.#marks[this.paint] ?? null;
    for (const [first, sets] of this.#sets) this.#store.addSets(first, sets);
    this.#renderer.use(this.#store);
  }

  /** Find how many Gaussians the budget holds, and return a header of so many: the GPU reserves no more. */
  #fitted(header: Header): Header {
    const { gaussians, terms } = header, { width, height } = this.lens;
    this.#share = terms / (gaussians || 1);
    const left = (this.#options.memory ?? memoryOfDevice()) - BESIDE - 16 * width * height;
    this.#room = ROW * Math.max(1, Math.floor(left / ROW / (bytesOfGaussian(header) + DRAWN + TERM * this.#share)));
    const most = Math.min(gaussians, this.#room);
    return { ...header, gaussians: most, terms: Math.ceil(most * this.#share) };
  }

  #finishStore(): void {
    const waiting = this.#waiting ?? [];
    this.#waiting = null;
    this.#sorted = this.#asked = null;
    this.#version += 1;
    for (const batch of waiting) this.#takeBatch(batch);
    this.redraw();
  }

  #takeOrder(order: Uint32Array, count: number, milliseconds: number): void {
    this.#figures.sort = milliseconds;
    if (this.#asked && !this.#lost) {
      this.#renderer.setOrder(order, count);
      this.#sorted = this.#asked;
    }
    this.#sorter.recycle(order);
    this.redraw();
  }

  #lose = (event: Event): void => {
    event.preventDefault(); // otherwise it never comes back
    this.#lost = true;
    this.#waiting ??= [];
    this.#sorter.forget();
    this.#say("contextlost");
  };

  #restore = (): void => {
    if (this.#gl.isContextLost()) return; // lost once more since
    this.#lost = false;
    this.#fence = null;
    this.#renderer = new Renderer(this.#gl, this.#options.precision);
    this.#store = null;
    if (this.#header) this.#refill();
    else this.#waiting = null;
    this.#say("contextrestored");
    this.redraw();
  };

  #request(): void {
    if (!this.#frame && !this.#immersed) this.#frame = requestAnimationFrame(() => this.#draw());
  }

  /** Have everything sorted for the camera, unless the last order will do. */
  #order(camera: Camera, least = 0.02): boolean {
    const last = this.#sorted;
    if (this.#waiting) return false;
    if (!this.#store) return true;
    const turned = last ? angleBetween(last.camera, camera) : 0;
    const still = last !== null && sameCamera(last.camera, camera);
    const slack = still
      ? last.region.right - camera.width
      : Math.ceil(Math.max(camera.width, camera.height) * Math.min(0.4, least + (1.5 * turned) / this.#eye.fovY));
    const { width, height } = camera;
    const region: Region = {
      left: -slack, top: -slack, right: width + slack, bottom: height + slack, levels: this.#mask(),
      most: this.#most.gaussians, lowered: this.#look.antialiased,
    };
    const same = still && last.region.levels === region.levels && last.region.most === region.most, done = same && last.version === this.#version;
    if (!done && !this.#sorter.sorting && !this.#waits && !(same && this.#rests())) {
      this.#asked = { camera, version: this.#version, region };
      this.#sorter.sort(camera, region);
    }
    return done;
  }

  /** Whether nothing is drawn yet. */
  get #waits(): boolean {
    return this.patient && this.#state.kind !== "failed" && !this.#isAllHere && !this.#settled.length;
  }

  get #isAllHere(): boolean {
    return this.#state.kind === "complete" && !this.#intake.isBusy;
  }

  /** Return whether a picture of the same view with more data has to wait: each takes cores from what loads it. */
  #rests(): boolean {
    const left = this.#fence ? LOOK_MS : this.#until - performance.now();
    if (left <= 0 || this.#settled.length || (this.#header?.plain && this.#isAllHere)) return false;
    this.#pause ||= setTimeout(() => {
      this.#pause = 0;
      this.#request();
    }, left) as unknown as number;
    return true;
  }

  /** Find out when the GPU has drawn a picture that was begun then. */
  #await(begin: number): void {
    setTimeout(() => {
      const gl = this.#gl, fence = this.#fence, now = performance.now();
      if (!fence || this.#lost) return;
      if (gl.getSyncParameter(fence, gl.SYNC_STATUS) !== gl.SIGNALED) return this.#await(begin);
      gl.deleteSync(fence);
      this.#fence = null;
      this.#figures.first ??= (now - this.#opened) / 1000;
      this.#until = now + (isSoftware(gl) ? REST_OF_CPU : REST) * (now - begin);
    }, LOOK_MS);
  }

  /** Draw what has come at once: nothing more loads that a picture would take cores from. */
  #endPause(): void {
    this.#until = 0;
    clearTimeout(this.#pause);
    this.#pause = 0;
    this.#request();
  }

  #count(time: number): void {
    this.#figures.frames += 1;
    this.#recent.push(time);
    if (this.#recent.length > 240) this.#recent.shift();
  }

  #draw(): void {
    this.#frame = 0;
    if (this.#lost) return;
    const begin = performance.now(), camera = this.lens;
    try {
      const ordered = this.#order(camera);
      if (this.#dirty) this.#paint(camera, begin);
      if (ordered && !this.#intake.isBusy) for (const resolve of this.#settled.splice(0)) resolve();
    } catch (error) {
      this.#lost = true; // no later picture can be better
      this.#say("problem", (error as Error).message);
    }
  }

  #paint(camera: Camera, begin: number): void {
    const { canvas } = this;
    if (this.#renderer.count && !this.#renderer.isReady()) return this.#request(); // what comes is taken meanwhile
    if (canvas.width !== camera.width || canvas.height !== camera.height) {
      canvas.width = camera.width;
      canvas.height = camera.height;
    }
    this.#dirty = false;
    this.#renderer.draw(camera, this.#look);
    if (!this.#fence && this.#renderer.count) {
      this.#fence = this.#gl.fenceSync(this.#gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
      this.#await(begin);
    }
    this.#count(begin);
    this.#figures.frame = performance.now() - begin;
    this.#say("frame");
  }
}

/** Return what this browser can blend into, null without WebGL2. */
export function supportedPrecision(): Precision | null {
  const gl = document.createElement("canvas").getContext("webgl2");
  if (!gl) return null;
  const precision = choosePrecision(gl);
  gl.getExtension("WEBGL_lose_context")?.loseContext();
  return precision;
}
