// What the page needs of the core's `Viewer`; its tests pass a stand-in.

import type { XrSession } from "../core/index.ts";
import type { Header, Marks, Paint, Pose, Source, SourceState } from "../core/types.ts";

export interface PageCamera extends Pose {
  fovY: number; // radians
}

export interface Statistics {
  fps: number;
  frames: number;
  drawn: number;
  gaussians: number;
  dropped: number; // did not fit into memory
  terms: number;
  bytes: number;
  rate: number;
  firstImageSeconds: number | null;
  state: SourceState;
}

export interface Pick {
  slot: number;
  id: number;
  weight: number;
  depth: number;
  position: [number, number, number];
  levels: [number, number]; // first and last
  opacity: number;
  terms: number;
  count: number; // Gaussians that reach the pixel
  color?: [number, number, number];
}

export type ViewerEvent = "header" | "state" | "frame" | "traffic" | "contextlost" | "contextrestored" | "problem";

export interface ViewerOptions {
  source: Source;
  camera?: PageCamera;
  background?: [number, number, number];
  memory?: number;
  maxPixelRatio?: number;
  patient?: boolean;
}

export interface ViewerLike {
  patient?: boolean; // nothing is drawn until all is here
  camera: PageCamera;
  background: [number, number, number];
  paint: Paint;
  marks: Marks;
  levelsShown: boolean[];
  termsShown: boolean;
  budget: number; // most Gaussians in a picture
  maxPixelRatio: number;
  readonly statistics: Statistics;
  readonly header: Header | null;
  pick(x: number, y: number): Promise<Pick | null>;
  screenshot(): Promise<Blob>;
  resize(): void;
  dispose(): void;
  enterXr?(session: XrSession): Promise<void>;
  addEventListener(type: ViewerEvent, listener: (event: Event) => void): void;
}
