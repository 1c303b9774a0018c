// Types of gsvis-viewer.js, made by "npm run build" in viewer/. Its README says how to use the module.

/** Numbers that define the tables of base colors and terms; `colors` of WELCOME (docs/streaming.md). */
export interface ColorTables {
  variant: "rgb" | "hsl";
  precision: {
    name: string; base: number; scale: number; axis: number; center: number; decay: number; intensity: number
  };
  base: [number, number][];
  scales: [number, number];
  decays: [number, number];
  intensity: number;
}

/**
 * Spherical harmonics of a bare scene: sets of K = (degree + 1)^2 - 1 coefficients, as bytes between `low` and `high`;
 * byte 128 is 0.
 */
export interface HarmonicTables {
  degree: 1 | 2 | 3;
  low: number[];
  high: number[];
  sets: number; // how many; each Gaussian has one
}

/** The symbol at each slot; for each symbol its first slot and, from bit 16 on, how many slots it has. */
export interface SymbolTable {
  slots: Uint16Array;
  spans: Uint32Array;
}

/** The code of a scene; a table without symbols is null. `steps` says which bits are left out. */
export interface Code {
  colors: ColorTables;
  tables: (SymbolTable | null)[];
  steps: { place: number; turn: number } | null;
}

/** A quality level; levels are listed lowest first. */
export interface Level {
  name: string;
  count: number;
}

/** What is known of a scene before its first Gaussian. */
export interface Header {
  gaussians: number;
  terms: number;
  chunks: number;
  levels: Level[];
  termBits: number;
  colors: ColorTables;
  harmonics: HarmonicTables | null;
  up: [number, number, number];
  metersPerUnit: number;
  antialiased: boolean; // the scene was trained with the opacities of antialiased splatting
  identity: string;
  code: Code | null; // of a stream
  plain?: boolean; // from this machine: all Gaussians come, and harmonics as whole texels with upper bits turned
}

/**
 * What has arrived, decoded as far as the CPU needs it. Slots number the Gaussians in the order of their arrival, from
 * 0 on; terms and
 * rows of chunks are numbered in the same way. All arrays may be transferred.
 */
export interface Batch {
  first: number; // slot of the first Gaussian here
  ids: Uint32Array; // (G)
  records: Uint32Array; // (4 G), 16 bytes of the wire each
  rows: Uint32Array; // (G), the row of each Gaussian's chunk
  means: Float32Array; // (3 G); none of parts from this machine
  firstRow: number;
  chunks: Float32Array; // (8 C): origin xyz, low, step xyz, stride; steps < 0: logarithmic
  boxes: Float32Array; // (6 C): low and high corner of each chunk
  chunkLevels: Uint8Array; // (2 C): first and last level
  firstTerm: number;
  terms: Uint32Array; // (2 M), the bits of each term's record, lowest first
  owners: Uint32Array; // (M), slots
  gone: Uint32Array; // (D), slots that others have replaced
  labels: Uint32Array | null; // (G), the set of harmonics of each Gaussian of a bare scene
}

/** Where an eye is: quaternion wxyz, world from camera. */
export interface Pose {
  position: [number, number, number];
  rotation: [number, number, number, number];
}

/** What an eye sees: tangents of the angles from its axis to the four borders. */
export interface View {
  left: number;
  right: number;
  up: number;
  down: number;
}

/** A pinhole camera; centers of pixels lie at +0.5. */
export interface Camera extends Pose {
  width: number;
  height: number;
  fx: number;
  fy: number;
  cx: number;
  cy: number;
}

/** How a source fares. `complete`: everything that this pose needs is here. */
export type SourceState =
  | { kind: "connecting" }
  | { kind: "streaming"; message?: string } // `message`: what is missing and gone round
  | { kind: "complete"; message?: string }
  | { kind: "waiting"; seconds: number; message: string } // the connection is lost; next try in `seconds`
  // does not try again; `code` of ERROR: 2 another version, 4 token or origin
  | { kind: "failed"; message: string; code?: number };

/** What has come so far. */
export interface Traffic {
  bytes: number; // received so far
  rate: number; // bytes a second of late
  gaussians: number;
  terms: number;
  replaced: number;
  reconnects: number;
}

/** What a source reports. */
export interface SourceEvents {
  header(header: Header, fresh: boolean): void; // fresh: drop everything drawn so far
  batch(batch: Batch): void;
  sets?(first: number, sets: Uint8Array): void; // of harmonics, 3 K bytes each: K coefficients of R, G, B; see `plain`
  state(state: SourceState): void;
  traffic(traffic: Traffic): void;
}

/** A stream, a static site, or a bare scene; works in its own Worker. */
export interface Source {
  start(events: SourceEvents): void;
  pose(pose: Pose): void;
  view(view: View): void;
  close(): void;
}

/** What the colors show. `color` is the scene itself. */
export type Paint = "color" | "opacity" | "level" | "arrival" | "terms" | "depth" | "visibility" | "weight";

/** A byte for each Gaussian, by its id: what the paints of these names show. */
export type Marks = Partial<Record<Paint, Uint8Array>>;

/** Return the camera of a picture of `width` x `height` pixels whose height covers the angle `fovY`, in radians. */
export declare function cameraOf(pose: Pose, width: number, height: number, fovY: number): Camera;

/** Return the unit quaternion wxyz of a rotation, row by row: from the largest of its four components. */
export declare function quaternionOf(rotation: readonly number[]): [number, number, number, number];

/** Return the rotation of a quaternion wxyz of any length > 0, world from camera, row by row. */
export declare function rotationOf(quaternion: readonly number[]): number[];

/** Return what a camera sees: tangents of the angles from its axis to the four borders. */
export declare function viewOf(camera: Camera): View;

/** Return how many bytes of the GPU a viewer takes at most on this device. */
export declare function memoryOfDevice(): number;

/** What lies under a pixel: the Gaussian with the largest weight, and the next ones. */
export interface Pick extends Picked {
  others: Picked[];
  total: number; // alpha of the pixel
  count: number; // Gaussians that reach it
}

/** A Gaussian under a pixel. */
export interface Picked {
  slot: number;
  id: number;
  weight: number; // its share of the pixel
  alpha: number;
  depth: number; // along the camera's axis, scene units
  position: [number, number, number];
  scales: [number, number, number];
  opacity: number;
  level: number; // the lowest that has it
  levels: [number, number]; // the lowest and the highest
  terms: number;
  color: [number, number, number]; // RGB as the eye sees it, >= 0
}

/** What a picture is blended in: 32 or 16 bits of a float, or 8 bits, which clip colors above 1. */
export type Precision = "float" | "half" | "bytes";

/** Options of `staticSource`. */
export interface StaticOptions {
  worker?: () => Worker; // makes the Worker where `static.js` does not lie beside this module
}

/** Return a source for the folder of a static scene, or for its scene.json. */
export declare function staticSource(url: string | URL, options?: StaticOptions): Source;

/** Options of `streamSource`. */
export interface StreamOptions {
  token?: string; // where the server asks for one and no cookie of it is set
  margin?: number; // radians around the view that are sent as if they were in it
  near?: number; // distance at which the view begins, scene units
  mostBytes?: number; // most memory for tables of a scene before its first Gaussian
  memory?: number; // bytes of records to hold at most: what is farthest from use goes; 0 for no limit
  worker?: () => Worker; // makes the network Worker where `network.js` does not lie beside this module
}

/** A stream; `retry` tries again at once while the source waits. */
export interface StreamSource extends Source {
  retry(): void;
}

/** Return a source for the address of a stream, such as `/stream/NAME`, of this page's host or another. */
export declare function streamSource(url: string | URL, options?: StreamOptions): StreamSource;

/** Return the RGB (>= 0) that an eye sees of a Gaussian with these terms. */
export declare function colorSeen(splat: Splat, terms: Term[], eye: [number, number, number], variant: "rgb" | "hsl"): [number, number, number];

/** Return the Gaussian of record `i`; `chunks` is as in `Batch`, and `row` counts from its beginning. */
export declare function decodeRecord(records: Uint32Array, i: number, chunks: Float32Array, row: number, tables: Tables): Splat;

/** Return term `i`; `terms` is as in `Batch`. */
export declare function decodeTerm(terms: Uint32Array, i: number, tables: Tables): Term;

/** Bits of a coordinate, a component of the quaternion and a log-scale, and the bit of a record at which they begin. */
export interface RecordLayout {
  position: number;
  rotation: number;
  scale: number;
  from: number;
  colorScale: boolean;
}

/** One Gaussian: geometry in scene units, base color in the variant's space. */
export interface Splat {
  mean: [number, number, number];
  quat: [number, number, number, number]; // wxyz, world from local
  scale: [number, number, number]; // standard deviations
  opacity: number;
  base: [number, number, number];
  colorScale: number;
}

/** All tables of a scene. `base` has one for each component, hue of `hsl` among them; `scales` is [1] for `rgb`. */
export interface Tables {
  variant: "rgb" | "hsl";
  base: [Float32Array, Float32Array, Float32Array];
  scales: Float32Array;
  theta: Float32Array; // polar angles from +z
  phi: Float32Array; // azimuths from +x to +y
  decays: Float32Array;
  intensities: Float32Array; // 0 in the middle
  widths: number[]; // bits of function, polar angle, azimuth, decay and each intensity
  layout: RecordLayout;
}

/** Return all tables that the numbers of a header define. */
export declare function tablesOf(colors: ColorTables): Tables;

/** One term: an SRBF around a center, and what it adds. */
export interface Term {
  function: number; // of hsl: 0 saturation, 1 lightness
  center: [number, number, number];
  decay: number;
  intensities: number[];
}

/** Return what this browser can blend into, null without WebGL2. */
export declare function supportedPrecision(): Precision | null;

/** Raised where the browser cannot draw at all. */
export declare class UnsupportedError extends Error {
}

/** Shows what a source gives on a canvas. Events of `ViewerEvent` say what has changed. */
export declare class Viewer extends EventTarget {
    #private;
    readonly canvas: HTMLCanvasElement;
    /** Whether nothing is drawn until all of the scene is here: something else is shown meanwhile. */
    patient: boolean;
    /** Draw on a canvas. Throws `UnsupportedError` where there is no WebGL2. */
    constructor(canvas: HTMLCanvasElement, options?: ViewerOptions);
    /** Show what a source gives, instead of what was shown. */
    open(source: Source): void;
    /** Stop everything and free what is held. */
    dispose(): void;
    /** What is known of the scene, null before the source has said it. */
    get header(): Header | null;
    /** How the source fares. */
    get state(): SourceState;
    /** Where the eye is and how wide it sees; setting it draws. */
    get camera(): Eye;
    set camera(eye: Eye);
    /** The exact camera of the canvas. Set one to draw it whatever the size of the canvas, until `camera` is set. */
    get lens(): Camera;
    set lens(lens: Camera);
    /** Pixels of the picture for each CSS pixel. */
    get pixelRatio(): number;
    /** Most pixels for each CSS pixel; Infinity leaves it to the device: 2, or 1.5 on small ones. */
    get maxPixelRatio(): number;
    set maxPixelRatio(ratio: number);
    /**
     * Most Gaussians that are drawn in a picture, Infinity for all: where more are in view, those with the largest
     * estimated share of it.
     */
    get budget(): number;
    set budget(gaussians: number);
    /** What the colors show. */
    get paint(): Paint;
    set paint(paint: Paint);
    /** What the paints `visibility` and `weight` show: a byte for each Gaussian, by its id; set for each scene anew. */
    get marks(): Marks;
    set marks(marks: Marks);
    /** Whether terms and spherical harmonics are shown. */
    get termsShown(): boolean;
    set termsShown(shown: boolean);
    /** What lies behind the scene: RGB from 0 to 1. */
    get background(): [number, number, number];
    set background(background: [number, number, number]);
    /** Whether opacities are lowered to make up for the blur of 0.3 square pixels. */
    get antialiased(): boolean;
    set antialiased(antialiased: boolean);
    /** Which levels are drawn, lowest first: a Gaussian is, if one of its levels is. Those not named are. */
    get levelsShown(): boolean[];
    set levelsShown(shown: boolean[]);
    /** Figures of this moment. */
    get statistics(): Statistics;
    /** Draw again with the next frame. */
    redraw(): void;
    /** Resolve when the canvas shows everything that has arrived, sorted for its camera. */
    settled(): Promise<void>;
    /** Return what lies under a point of the canvas, in CSS pixels from its upper left corner. */
    pick(x: number, y: number): Promise<Pick | null>;
    /** Return the pixels of a camera, RGBA from the upper left corner; those of the canvas by default. */
    capture(lens?: Camera): Promise<ImageData>;
    /** Return a picture as PNG, of the size of the canvas or another. */
    screenshot(width?: number, height?: number): Promise<Blob>;
    /** Take the size of the canvas on the page; happens by itself when it changes. */
    resize(): void;
    /** Show the scene in an immersive session, from where the camera is, until the session ends. */
    enterXr(session: XrSession): Promise<void>;
}

/** Where the eye is, and the angle that the height of the canvas covers, in radians. */
export interface Eye extends Pose {
  fovY: number;
}

/** How a viewer fares. */
export interface Statistics {
  fps: number; // of the last second; 0 while nothing moves
  frames: number; // so far
  frameMilliseconds: number; // of the main thread, last frame
  sortMilliseconds: number; // in the Worker, last sort
  appendMilliseconds: number; // of the main thread, last batch
  gaussians: number; // on the GPU
  drawn: number; // in the last picture, before those outside of it are cut off
  replaced: number;
  terms: number;
  dropped: number; // did not fit into memory
  gpuBytes: number;
  firstImageSeconds: number | null; // from `open` until the GPU has drawn the first Gaussians
  precision: Precision;
  state: SourceState;
  bytes: number;
  rate: number; // bytes a second of late
  reconnects: number;
}

/** Names of events: `problem` has a sentence for people as `detail`, the others say that a property has changed. */
export type ViewerEvent = "header" | "state" | "traffic" | "frame" | "contextlost" | "contextrestored" | "problem";

/** What may be set when a viewer is made. */
export interface ViewerOptions {
  source?: Source;
  camera?: Eye; // where the eye is at first
  background?: [number, number, number];
  antialiased?: boolean; // as the scene states by default
  precision?: Precision; // of the blended picture, or the finest there is; half by default, float with SwiftShader
  maxPixelRatio?: number;
  budget?: number; // most Gaussians in a picture; all by default
  memory?: number; // bytes on the GPU
  sortWorker?: WorkerStart;
  patient?: boolean; // see `Viewer.patient`
}

/** What is used of WebXR; browsers' own objects fit. */
export interface XrSession {
  requestReferenceSpace(type: string): Promise<object>;
  requestAnimationFrame(callback: (time: number, frame: XrFrame) => void): number;
  updateRenderState(state: { baseLayer: XrLayer }): Promise<void> | void;
  addEventListener(type: "end", listener: () => void): void;
}

/** Starts the Worker; a page in one file passes its own. */
type WorkerStart = () => Worker;

interface XrFrame {
  getViewerPose(space: object): { views: readonly XrView[] } | null | undefined;
}

interface XrLayer {
  framebuffer: WebGLFramebuffer | null;
  getViewport(view: XrView): { x: number; y: number; width: number; height: number } | null | undefined;
}

interface XrView {
  projectionMatrix: Float32Array;
  transform: {
    position: { x: number; y: number; z: number }; orientation: { x: number; y: number; z: number; w: number }
  };
}

export {};
