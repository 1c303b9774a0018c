// The page's half of embedding: answers the page around it. A script of its own, loaded in frames alone.
// Only the direct parent is heard. What shows the scene's content, pictures and picks, goes to the page's own origin
// and to origins that whoever serves the page names. No message holds an address of the page, which may have a token.

import { resolve } from "../page/address.ts";
import type { View } from "../page/hash.ts";
import { fields, vector } from "../page/json.ts";
import { MODES } from "../page/navigator.ts";
import { offer } from "../page/parts.ts";
import { project } from "../page/project.ts";
import { budgetOf, qualityOf } from "../page/quality.ts";
import { FOV_DEGREES } from "../page/rig.ts";
import type { Look, Player, Stage } from "../page/stage.ts";
import { clamp, distance } from "../page/vector.ts";
import type { Vec3 } from "../page/vector.ts";
import { messageOf } from "./protocol.ts";
import type { Answer, Ask, PageEvent } from "./protocol.ts";

const FARTHEST = 1e6; // of a coordinate, as on the wire
const LOOKS_MS = 100; // between two looks at what has changed
const STILL = 6; // pixels that a click may move
const NO_READER = "expected a page that may read the scene: its own origin, or one that its server names (--origins)";

type Answers = Record<string, (...args: unknown[]) => unknown>;

class Voice {
  #home: string | null = null; // origin of the page around this one, once it listens
  #before: Record<string, string> = {};
  #pressed: [number, number] | null = null;

  constructor(private readonly stage: Stage, private readonly embedders: readonly string[]) {
    addEventListener("message", (event) => void this.#hear(event));
    document.addEventListener("pointerdown", ({ clientX, clientY }) => { this.#pressed = [clientX, clientY]; }, true);
    document.addEventListener("pointerup", (event) => void this.#click(event), true);
    document.addEventListener("gsvis-hotspot", (event) => this.#emit("hotspot", (event as CustomEvent).detail));
    setInterval(() => this.#look(), LOOKS_MS);
    this.#post("*", { gsvis: "event", name: "here", detail: null });
  }

  /** Whether the page around this one may see what the scene shows. */
  get #reads(): boolean {
    const { embedders } = this, home = this.#home;
    if (embedders.includes("*")) return true;
    return home !== null && home !== "null" && [location.origin, ...embedders].includes(home);
  }

  #post(to: string, message: PageEvent | Answer): void {
    parent.postMessage(message, to === "null" ? "*" : to); // an origin without a name has no other spelling
  }

  #emit(name: PageEvent["name"], detail: unknown): void {
    if (this.#home !== null) this.#post(this.#home, { gsvis: "event", name, detail });
  }

  async #hear({ source, origin, data }: MessageEvent): Promise<void> {
    const ask = messageOf<Ask>(data, "ask");
    if (source !== parent || !ask) return;
    this.#home = origin;
    const does = this.#answers(), { id } = ask;
    try {
      if (!Object.hasOwn(does, ask.name)) throw new Error(`expected ${Object.keys(does).join(", ")}`);
      const value = await does[ask.name](...(Array.isArray(ask.args) ? ask.args : []));
      this.#post(origin, { gsvis: "answer", id, value });
    } catch (error) {
      this.#post(origin, { gsvis: "answer", id, error: error instanceof Error ? error.message : String(error) });
    }
  }

  /** Return what may be asked. */
  #answers(): Answers {
    const { stage } = this;
    const read = <T>(work: () => T): T => {
      if (this.#reads) return work();
      throw new Error(NO_READER);
    };
    return {
      listen: () => {
        this.#before = {};
        this.#look();
      },
      flyTo: (view, options) => stage.go(viewOf(view, stage.look()), fields(options)?.jump === true),
      show: (options) => this.#show(fields(options) ?? {}),
      project: (point) => {
        const at = vector(point, FARTHEST), { view, up, width, height } = stage.look();
        if (!at) throw new Error("point: expected [x, y, z]");
        return project(at, view, up, width, height);
      },
      pick: (x, y) => read(() => stage.find(Number(x), Number(y))),
      screenshot: () => read(() => stage.picture()),
      load: (address) => open(String(address), stage),
      play: () => this.#player.play(),
      pause: () => this.#player.pause(),
      seek: (seconds) => {
        if (typeof seconds !== "number" || !Number.isFinite(seconds)) throw new Error("seconds: expected a number");
        this.#player.seek(seconds);
      },
    };
  }

  get #player(): Player {
    const player = this.stage.player();
    if (!player) throw new Error("expected an animation (animTracks in settings.json): this page has none");
    return player;
  }

  #show(options: Record<string, unknown>): void {
    const mode = MODES.find((each) => each === options.mode);
    if (mode) this.stage.turn(mode);
    const quality = qualityOf(options.quality);
    if (quality) this.stage.refine(quality, budgetOf(options.budget));
    if (typeof options.noui === "boolean") document.documentElement.toggleAttribute("data-bare", options.noui);
  }

  /** Tell what is new. */
  #look(): void {
    const now = this.stage.look(), { eye, to, fov } = now.view;
    const { state, gaussians, of, up, mode } = now;
    this.#renew("pose", { eye, to, fov, up, mode });
    this.#renew("progress", { state, gaussians, of, share: of ? gaussians / of : 0 });
    const player = this.stage.player();
    if (player) {
      const { playing, seconds, duration, loops } = player;
      this.#renew("animation", { playing, seconds, duration, loops });
    }
    if (now.drawn) this.#renew("ready", { name: this.stage.name, gaussians: of, up });
    if (state === "failed" || (state === "waiting" && !of)) this.#renew("error", { message: now.message });
  }

  /** Tell an event whose detail has changed. */
  #renew(name: PageEvent["name"], detail: unknown): void {
    const text = JSON.stringify(detail);
    if (this.#home === null || this.#before[name] === text) return;
    this.#before[name] = text;
    this.#emit(name, detail);
  }

  async #click({ target, clientX: x, clientY: y }: PointerEvent): Promise<void> {
    const [px, py] = this.#pressed ?? [Infinity, 0];
    if (!(target instanceof HTMLCanvasElement) || Math.hypot(x - px, y - py) > STILL || !this.#reads) return;
    const found = await this.stage.find(x, y);
    if (found) this.#emit("pick", { ...found, x, y });
  }
}

/** Return the view of a message; what it leaves out stays as it is. */
function viewOf(value: unknown, { view, mode }: Look): View {
  const it = fields(value), read = (key: "eye" | "to"): Vec3 | null => (
    it?.[key] === undefined ? view[key] : vector(it[key], FARTHEST));
  const [eye, to] = [read("eye"), read("to")];
  if (!it || !eye || !to || !(distance(eye, to) > 1e-9)) {
    throw new Error("view: expected {eye: [x, y, z], to: [x, y, z]}, two places");
  }
  const fov = typeof it.fov === "number" && Number.isFinite(it.fov) ? clamp(it.fov, ...FOV_DEGREES) : view.fov;
  return { eye, to, fov, mode: MODES.find((each) => each === it.mode) ?? mode };
}

/** Load the page again with another scene. */
function open(address: string, stage: Stage): void {
  const found = resolve(address, location.href, stage.permits), page = new URL(location.href);
  if (!found) throw new Error(`address: expected one that the page may open, got ${address.slice(0, 200)}`);
  page.searchParams.set("content", found);
  page.hash = "";
  setTimeout(() => location.replace(page), 0); // behind the answer
}

offer("embed", (stage, embedders) => void new Voice(stage, embedders));
