// `<gsvis-viewer>`: a scene in a page of somebody else. It holds a page of gsvis in a frame, which keeps the styles,
// scripts and keys of both apart, and speaks with it by messages. Nothing in here draws.
import { messageOf } from "./protocol.ts";
import type { Answer, Ask, PageEvent } from "./protocol.ts";

export type Point = [number, number, number];
export type Mode = "orbit" | "fly" | "walk";
export type Quality = "auto" | "low" | "medium" | "high";

/** A view, in the frame and units of the scene. `fov`: degrees from the lower to the upper border. */
export interface SceneView {
  eye: Point;
  to: Point;
  fov?: number;
  mode?: Mode;
}

/** A point in the element: CSS pixels from its upper left corner, and scene units along the axis of the camera. */
export interface ScenePlace {
  x: number;
  y: number;
  depth: number;
}

/** The Gaussian with the largest weight at a pixel. */
export interface ScenePick {
  id: number;
  position: Point;
  depth: number;
  weight: number;
  opacity: number;
}

const ATTRIBUTES = ["src", "eye", "to", "up", "fov", "mode", "noui", "settings", "poster", "sandbox", "lang", "quality", "budget"] as const;
const VIEW = ["eye", "to", "fov"];
const SHOWN = ["mode", "noui", "quality", "budget"];
const ALLOWED = "fullscreen; xr-spatial-tracking; clipboard-write; gamepad";
const LONGEST_MS = 30_000; // until a question without an answer fails

/** The element. Its events are `ready`, `progress`, `pose`, `pick`, `hotspot`, `animation` and `error`, with a `detail` each. */
export class GsvisViewerElement extends HTMLElement {
  static readonly observedAttributes: readonly string[] = ATTRIBUTES;
  readonly #frame = document.createElement("iframe");
  readonly #poster = document.createElement("img");
  readonly #asked = new Map<number, { done(value: unknown): void; failed(error: Error): void }>();
  #next = 1;
  #open = false; // the page has said that it listens
  #planned = false;
  #waiting: Ask[] = [];

  constructor() {
    super();
    const root = this.attachShadow({ mode: "closed" });
    const full = { position: "absolute", inset: "0", width: "100%", height: "100%", border: "0" };
    Object.assign(this.#frame.style, full);
    Object.assign(this.#poster.style, full, { objectFit: "cover", pointerEvents: "none" });
    this.#frame.allow = ALLOWED;
    this.#poster.alt = "";
    const sheet = new CSSStyleSheet(); // no `<style>`: the policy of a page may forbid it
    sheet.replaceSync(":host { display: block; position: relative; min-height: 12em; overflow: hidden }");
    root.adoptedStyleSheets = [sheet];
    root.append(this.#frame);
    this.addEventListener("ready", () => this.#poster.remove());
    this.#poster.addEventListener("error", () => this.#poster.remove());
  }

  connectedCallback(): void {
    addEventListener("message", this.#hear);
    this.#plan();
  }

  disconnectedCallback(): void {
    removeEventListener("message", this.#hear);
    this.#forget("the element has left its page");
  }

  attributeChangedCallback(name: string, before: string | null, now: string | null): void {
    if (before === now || !this.isConnected) return;
    if (VIEW.includes(name) && this.#open && this.eye && this.to) void this.flyTo(this.#view).catch(() => undefined);
    else if (SHOWN.includes(name)) void this.#show().catch(() => undefined);
    else if (name === "poster") this.#showPoster();
    else this.#plan();
  }

  get src(): string { return this.getAttribute("src") ?? ""; }
  set src(address: string) { this.setAttribute("src", address); }
  get settings(): string { return this.getAttribute("settings") ?? ""; }
  set settings(address: string) { this.#set("settings", address); }
  get poster(): string { return this.getAttribute("poster") ?? ""; }
  set poster(address: string) { this.#set("poster", address); }
  get noui(): boolean { return this.hasAttribute("noui"); }
  set noui(bare: boolean) { this.toggleAttribute("noui", bare); }
  get mode(): Mode | null { return this.getAttribute("mode") as Mode | null; }
  set mode(mode: Mode | null) { this.#set("mode", mode); }
  get quality(): Quality { return (this.getAttribute("quality") as Quality | null) ?? "auto"; }
  set quality(quality: Quality) { this.#set("quality", quality); }
  get budget(): number | null { return Number(this.getAttribute("budget")) || null; }
  set budget(gaussians: number | null) { this.#set("budget", gaussians ? String(gaussians) : null); }
  get eye(): Point | null { return pointOf(this.getAttribute("eye")); }
  set eye(point: Point | null) { this.#set("eye", point && point.join(",")); }
  get to(): Point | null { return pointOf(this.getAttribute("to")); }
  set to(point: Point | null) { this.#set("to", point && point.join(",")); }
  get up(): Point | null { return pointOf(this.getAttribute("up")); }
  set up(point: Point | null) { this.#set("up", point && point.join(",")); }

  /** Fly to a view; what it leaves out stays as it is. `jump` goes there at once. */
  flyTo(view: Partial<SceneView>, options: { jump?: boolean } = {}): Promise<void> {
    return this.#ask("flyTo", view, options) as Promise<void>;
  }

  /** Return where a point of the scene is drawn, perhaps outside of the picture; null behind the eye. */
  project(point: Point): Promise<ScenePlace | null> {
    return this.#ask("project", point) as Promise<ScenePlace | null>;
  }

  /** Return the Gaussian at a point of the element, null where none is. Needs the trust of the page; see embed.md. */
  pick(x: number, y: number): Promise<ScenePick | null> {
    return this.#ask("pick", x, y) as Promise<ScenePick | null>;
  }

  /** Return the picture as PNG. Needs the trust of the page. */
  screenshot(): Promise<Blob> {
    return this.#ask("screenshot") as Promise<Blob>;
  }

  /** Play the animation of the settings, from where it is. */
  play(): Promise<void> {
    return this.#ask("play") as Promise<void>;
  }

  pause(): Promise<void> {
    return this.#ask("pause") as Promise<void>;
  }

  /** Go to a second of the animation; it plays on if it plays. */
  seek(seconds: number): Promise<void> {
    return this.#ask("seek", seconds) as Promise<void>;
  }

  /** Show another page or scene; resolves with its first picture. */
  load(src: string): Promise<void> {
    const shown = new Promise<void>((done, failed) => {
      this.addEventListener("ready", () => done(), { once: true });
      this.addEventListener("error", (event) => {
        failed(new Error((event as unknown as CustomEvent<{ message: string }>).detail.message));
      }, { once: true });
    });
    if (src === this.src) this.#plan();
    else this.src = src;
    return shown;
  }

  #set(name: string, value: string | null): void {
    if (value) this.setAttribute(name, value);
    else this.removeAttribute(name);
  }

  get #view(): Partial<SceneView> {
    const { eye, to } = this, fov = Number(this.getAttribute("fov"));
    return { ...(eye && { eye }), ...(to && { to }), ...(fov > 0 && { fov }) };
  }

  #show(): Promise<unknown> {
    return this.#open ? this.#ask("show", { noui: this.noui, mode: this.mode, quality: this.quality, budget: this.budget }) : Promise.resolve();
  }

  /** Open the page once, however many attributes have changed. */
  #plan(): void {
    if (this.#planned) return;
    this.#planned = true;
    queueMicrotask(() => {
      this.#planned = false;
      if (this.isConnected) this.#load();
    });
  }

  #load(): void {
    this.#forget("another scene is shown");
    this.#open = false;
    const { src } = this, sandbox = this.getAttribute("sandbox");
    if (!src) return;
    if (sandbox === null) this.#frame.removeAttribute("sandbox");
    else this.#frame.setAttribute("sandbox", sandbox);
    this.#frame.title = this.title || this.getAttribute("aria-label") || "3D scene";
    this.#showPoster();
    this.#frame.src = addressOf(src, this);
  }

  #showPoster(): void {
    if (!this.poster) return this.#poster.remove();
    this.#poster.src = this.poster;
    this.#frame.after(this.#poster);
  }

  /** The origin that the page speaks from. */
  get #origin(): string {
    const sandbox = this.getAttribute("sandbox");
    if (sandbox !== null && !sandbox.includes("allow-same-origin")) return "null";
    return new URL(this.#frame.src, document.baseURI).origin;
  }

  #ask(name: string, ...args: unknown[]): Promise<unknown> {
    const ask: Ask = { gsvis: "ask", id: this.#next++, name, args };
    const answered = new Promise((done, failed) => {
      const timer = setTimeout(() => failed(new Error(`${name}: the page does not answer`)), LONGEST_MS);
      const end = <T>(work: (value: T) => void) => (value: T): void => {
        clearTimeout(timer);
        work(value);
      };
      this.#asked.set(ask.id, { done: end(done), failed: end(failed) });
    });
    if (this.#open) this.#post(ask);
    else this.#waiting.push(ask);
    return answered;
  }

  #post(ask: Ask): void {
    const origin = this.#origin;
    this.#frame.contentWindow?.postMessage(ask, origin === "null" ? "*" : origin);
  }

  readonly #hear = ({ source, origin, data }: MessageEvent): void => {
    if (source !== this.#frame.contentWindow || origin !== this.#origin) return;
    const answer = messageOf<Answer>(data, "answer");
    const event = messageOf<PageEvent>(data, "event");
    if (answer) {
      const asked = this.#asked.get(answer.id);
      this.#asked.delete(answer.id);
      if (typeof answer.error === "string") asked?.failed(new Error(answer.error));
      else asked?.done(answer.value);
    } else if (event?.name === "here") {
      this.#open = true;
      void this.#ask("listen").catch(() => undefined);
      for (const ask of this.#waiting.splice(0)) this.#post(ask);
    } else if (event) {
      this.dispatchEvent(new CustomEvent(event.name, { detail: event.detail }));
    }
  };

  /** Fail what is still asked. */
  #forget(why: string): void {
    const all = [...this.#asked.values()];
    this.#asked.clear();
    this.#waiting = [];
    for (const { failed } of all) failed(new Error(why));
  }
}

/** Return the point of a text such as "1,2,0.5"; null for any other text. */
function pointOf(text: string | null): Point | null {
  const parts = (text ?? "").split(/[\s,]+/).filter(Boolean).map(Number);
  return parts.length === 3 && parts.every(Number.isFinite) ? (parts as Point) : null;
}

/** Return the address of the page to show: `src` itself, or the page beside this module for a bare scene. */
function addressOf(src: string, element: GsvisViewerElement): string {
  const scene = new URL(src, document.baseURI), isScene = /^wss?:$/.test(scene.protocol) || /\/scene\.json$/.test(scene.pathname);
  const page = isScene ? new URL("page.html", import.meta.url) : scene;
  if (isScene) page.searchParams.set("content", scene.href);
  const settings = element.getAttribute("settings");
  if (settings) page.searchParams.set("settings", new URL(settings, document.baseURI).href);
  const lang = element.closest<HTMLElement>("[lang]")?.lang; // its own, else that of the page around it
  if (lang && !page.searchParams.has("lang")) page.searchParams.set("lang", lang);
  for (const name of ["quality", "budget"]) {
    const chosen = element.getAttribute(name);
    if (chosen) page.searchParams.set(name, chosen);
  }
  if (element.noui) page.searchParams.set("noui", "");
  const view = ["eye", "to", "up", "fov", "mode"].map((name) => [name, element.getAttribute(name)?.replace(/[\s,]+/g, ",")]);
  const hash = view.filter(([, value]) => value).map(([name, value]) => `${name}=${value}`).join("&");
  if (hash) page.hash = hash;
  return page.href;
}

declare global {
  interface HTMLElementTagNameMap {
    "gsvis-viewer": GsvisViewerElement;
  }
}

if (!customElements.get("gsvis-viewer")) customElements.define("gsvis-viewer", GsvisViewerElement);
