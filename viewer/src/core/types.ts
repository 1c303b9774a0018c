// What passes between the parts of the viewer: a source gives a header and batches, the renderer draws them.
// Frames are those of the scene: OpenCV cameras (+x right, +y down, +z forward), quaternions wxyz, world from camera.

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
