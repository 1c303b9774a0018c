// A page of somebody else that uses the module with its types; test/built.test.ts has tsc check it, and it never runs.
import "gsvis-viewer/element";
import {
  cameraOf, type Batch, type Header, type Pick, type Source, type SourceEvents, staticSource, streamSource,
  supportedPrecision, UnsupportedError, Viewer,
} from "gsvis-viewer";

const canvas = document.querySelector("canvas") as HTMLCanvasElement;

export async function show(url: string, token: string): Promise<Pick | null> {
  const source = streamSource(url, { token, worker: () => new Worker("network.js") });
  const viewer = new Viewer(
    canvas, { source, background: [0, 0, 0], memory: 2 ** 28, precision: supportedPrecision() ?? "bytes" },
  );
  viewer.camera = { position: [0, 0, 1.6], rotation: [0.5, -0.5, 0.5, -0.5], fovY: 1 };
  viewer.lens = cameraOf(viewer.camera, 640, 360, 1);
  viewer.paint = "depth";
  viewer.levelsShown = [true, false];
  viewer.addEventListener("problem", (event) => console.log((event as CustomEvent<string>).detail));
  await viewer.settled();
  const blob: Blob = await viewer.screenshot(640, 360), header: Header | null = viewer.header;
  const { fps, firstImageSeconds } = viewer.statistics;
  console.log(blob.size, header?.levels[0].name, fps.toFixed(1), firstImageSeconds?.toFixed(2));
  if (viewer.state.kind === "waiting") source.retry();
  // @ts-expect-error: no paint has this name
  viewer.paint = "nonsense";
  // @ts-expect-error: statistics are read alone
  viewer.statistics = null;
  // @ts-expect-error: a static source has nothing to try again
  staticSource("scene/").retry();
  viewer.dispose();
  return viewer.pick(10, 10);
}

/** A source of one's own. */
export class OneBatch implements Source {
  #events: SourceEvents | null = null;

  constructor(private readonly header: Header, private readonly batch: Batch) {}

  start(events: SourceEvents): void {
    this.#events = events;
    events.header(this.header, true);
    events.batch({ ...this.batch, gone: new Uint32Array(0) });
    events.state({ kind: "complete" });
  }

  pose(): void {}
  view(): void {}

  close(): void {
    this.#events?.state({ kind: "failed", message: "closed" });
  }
}

export async function embed(): Promise<Blob> {
  const element = document.createElement("gsvis-viewer");
  element.src = "https://example.org/site/";
  await element.flyTo({ eye: [1, 2, 3] }, { jump: true });
  const place: { x: number; y: number } | null = await element.project([0, 0, 1]);
  // @ts-expect-error: no mode has this name
  element.mode = "swim";
  console.log(place?.x);
  return element.screenshot();
}

export const isUnsupported = (error: unknown): error is UnsupportedError => error instanceof UnsupportedError;
