// What the module `gsvis-viewer` exports: a viewer for a canvas, and the sources it shows.

export { cameraOf, quaternionOf, rotationOf, viewOf } from "./camera.ts";
export { memoryOfDevice } from "./device.ts";
export type { Pick, Picked } from "./picking.ts";
export type { Precision } from "./renderer.ts";
export { type StaticOptions, staticSource } from "./static-source.ts";
export { type StreamOptions, type StreamSource, streamSource } from "./stream-source.ts";
export {
  colorSeen, decodeRecord, decodeTerm, type RecordLayout, type Splat, type Tables, tablesOf, type Term,
} from "./tables.ts";
export type * from "./types.ts";
export { supportedPrecision, UnsupportedError, Viewer } from "./viewer.ts";
export type { Eye, Statistics, ViewerEvent, ViewerOptions } from "./viewer-types.ts";
export type { XrSession } from "./xr.ts";
