// The page with stand-ins for viewer and source, for tests of its controls: it draws a room of dots on a plain canvas.
// `window.fake` lets a test change the state of the source and read what the page has asked for.

import type { Header, Marks, Paint, SourceState } from "../src/core/types.ts";
import { readAddress } from "../src/page/address.ts";
import { meta } from "../src/page/dom.ts";
import { ViewPage } from "../src/page/view.ts";
import { speakLanguage } from "../src/page/words.ts";
import type { PageCamera, Pick, Statistics, ViewerLike, ViewerOptions } from "../src/page/viewer-like.ts";

const HEADER: Header = {
  gaussians: 780_582, terms: 1_240_000, chunks: 3300, termBits: 44, harmonics: null, up: [0, 0, 1], metersPerUnit: 1, antialiased: false,
  identity: "0".repeat(64), code: null,
  levels: [{ name: "low", count: 145_900 }, { name: "medium", count: 272_400 }, { name: "high", count: 780_582 }],
  colors: {
    variant: "rgb", precision: { name: "wire", base: 8, scale: 0, axis: 6, center: 6, decay: 4, intensity: 6 },
    base: [[0, 1], [0, 1], [0, 1]], scales: [1, 1], decays: [1, 30], intensity: 1,
  },
};

class FakeViewer extends EventTarget implements ViewerLike {
  header: Header | null = null;
  background: [number, number, number];
  paint: Paint = "color";
  marks: Marks = {};
  levelsShown: boolean[] = [];
  termsShown = true;
  budget = Infinity;
  maxPixelRatio = Infinity;
  disposed = false;
  picks: [number, number][] = [];
  state: SourceState = { kind: "connecting" };
  share = 0;
  #camera: PageCamera = { position: [0, 0, 0], rotation: [1, 0, 0, 0], fovY: 1 };
  #dots = dots();

  constructor(private readonly canvas: HTMLCanvasElement, options: ViewerOptions) {
    super();
    if (new URLSearchParams(location.search).has("nowebgl")) throw new Error("This browser does not offer WebGL2.");
    this.background = options.background ?? [0, 0, 0];
    Object.assign(window, { fake: this });
    if (new URLSearchParams(location.search).has("silent")) return; // a server that never answers
    setTimeout(() => {
      this.header = HEADER;
      this.dispatchEvent(new Event("header"));
      this.become({ kind: "streaming" }, 0.42);
    }, 20);
  }

  /** Take another state, as the source would report it. */
  become(state: SourceState, share = this.share): void {
    [this.state, this.share] = [state, share];
    this.dispatchEvent(new Event("state"));
  }

  /** Say the header again, as after a lost connection; with an identity it is of another scene. */
  greet(identity = HEADER.identity): void {
    this.header = { ...HEADER, identity };
    this.dispatchEvent(new Event("header"));
  }

  get camera(): PageCamera {
    return this.#camera;
  }

  set camera(camera: PageCamera) {
    this.#camera = camera;
    this.draw();
  }

  get statistics(): Statistics {
    const share = this.share;
    return {
      fps: 58, frames: 100, drawn: 412_000 * share, gaussians: Math.round(780_582 * share), dropped: 0,
      terms: Math.round(1_240_000 * share),
      bytes: 7.2e6 * share, rate: 1.25e6, firstImageSeconds: 0.43, state: this.state,
    };
  }

  async pick(x: number, y: number): Promise<Pick | null> {
    this.picks.push([x, y]);
    if (y < 5) return null;
    return {
      slot: 41_233, id: 52_110, weight: 0.62, depth: 3.2, position: [3.4, 1.2, 1.1], levels: [0, 1], opacity: 0.91,
      terms: 2, count: 14,
    };
  }

  screenshot(): Promise<Blob> {
    return new Promise((done) => this.canvas.toBlob((blob) => done(blob ?? new Blob())));
  }

  resize(): void {
    this.draw();
  }

  dispose(): void {
    this.disposed = true;
  }

  private draw(): void {
    const { canvas } = this;
    [canvas.width, canvas.height] = [canvas.clientWidth, canvas.clientHeight];
    const context = canvas.getContext("2d");
    if (!context) return;
    const { width, height } = canvas;
    const { position: eye, rotation: [w, x, y, z], fovY } = this.#camera;
    const focal = height / 2 / Math.tan(fovY / 2);
    const turn = [
      [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
      [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
      [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
    ];
    context.fillStyle = `rgb(${this.background.map((c) => Math.round(255 * c)).join(" ")})`;
    context.fillRect(0, 0, width, height);
    const seen = this.#dots.map(({ at, color, size }) => {
      const offset = at.map((c, k) => c - eye[k]);
      const [u, v, depth] = turn.map((row) => row[0] * offset[0] + row[1] * offset[1] + row[2] * offset[2]);
      return { u, v, depth, color, size };
    }).filter(({ depth }) => depth > 0.15).sort((a, b) => b.depth - a.depth);
    for (const { u, v, depth, color, size } of seen) {
      context.fillStyle = color;
      context.beginPath();
      context.ellipse(
        width / 2 + (focal * u) / depth, height / 2 + (focal * v) / depth, (focal * size) / depth,
        (focal * size) / depth, 0, 0, 7,
      );
      context.fill();
    }
  }
}

function dots(): { at: [number, number, number]; color: string; size: number }[] {
  let seed = 7;
  const random = (): number => (seed = (seed * 16807) % 2147483647) / 2147483647;
  const found: { at: [number, number, number]; color: string; size: number }[] = [];
  for (let i = 0; i < 500; i++) {
    const side = Math.floor(random() * 4);
    const [p, q] = [random(), random()];
    const at: [number, number, number] = side === 0 ? [p * 6, q * 4, 0] : side === 1 ? [p * 6, 4, q * 2.6]
      : side === 2 ? [6, p * 4, q * 2.6] : [p * 6, q * 4, 2.6];
    const tone = [[30, 26, 34], [210, 16, 62], [200, 20, 48], [40, 12, 80]][side];
    found.push(
      {
        at, size: 0.26 + 0.1 * random(),
        color: `hsl(${tone[0] + 20 * random()} ${tone[1]}% ${tone[2] + 8 * random()}%)`,
      }
    );
  }
  for (let i = 0; i < 120; i++) {
    const [a, b] = [random() * 6.28, random()];
    found.push(
      {
        at: [4 + 0.4 * Math.cos(a), 2 + 0.4 * Math.sin(a), b * 0.8], size: 0.1,
        color: `hsl(${10 + 20 * random()} 60% ${36 + 16 * random()}%)`,
      }
    );
  }
  return found;
}

await speakLanguage();
const page = readAddress(
  location.href, { scene: meta("scene"), content: meta("content"), settings: meta("settings"), origins: meta("origins"), visitor: meta("visitor") },
);
if (page.scene) {
  const source = { start: () => undefined, pose: () => undefined, view: () => undefined, close: () => undefined };
  const asked: (string | null)[] = [];
  Object.assign(window, { asked });
  new ViewPage(page.scene, page, {
    makeViewer: (canvas, options) => new FakeViewer(canvas, options),
    makeSource: (_scene, token) => (asked.push(token), source),
  });
}
