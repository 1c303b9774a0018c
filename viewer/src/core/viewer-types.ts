// What a viewer takes and says.
import type { Precision } from "./renderer.ts";
import type { WorkerStart } from "./sorter.ts";
import type { Pose, Source, SourceState } from "./types.ts";

/** Where the eye is, and the angle that the height of the canvas covers, in radians. */
export interface Eye extends Pose {
  fovY: number;
}

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
