// Authoring: edits the views, hotspots, background and camera path of a settings.json in the page, and downloads it.
// What is edited is the file itself, as SuperSplat writes it (version 2, its frame), kept in this browser as a draft.
// A script of its own: pages load it with `?author`.

import { make, on } from "./dom.ts";
import { icon } from "./icons.ts";
import type { IconName } from "./icons.ts";
import { fields, list, vector } from "./json.ts";
import type { Fields } from "./json.ts";
import { offer, textOfPage } from "./parts.ts";
import { DEGREES } from "./rig.ts";
import type { Stage } from "./stage.ts";
import type { Vec3 } from "./vector.ts";

const RATE = 30; // frames a second of camera paths
const MOST_STEPS = 50; // that can be undone
const DIGITS = 5;

interface Pose {
  position: Vec3;
  target: Vec3;
  fov: number; // degrees of the longer side
}

interface Spot {
  position: Vec3;
  title: string;
  text: string;
  extras: Fields;
  camera: { initial: Pose };
}

/** A settings.json; other fields of a file stay as they are. */
export interface Draft extends Fields {
  version: 2;
  background: { color: Vec3 };
  cameras: { name?: string; initial: Pose }[];
  annotations: Spot[];
  animTracks: unknown[];
  startMode: string;
}

const EFFECTS = {
  sharpness: { enabled: false, amount: 0 }, bloom: { enabled: false, intensity: 1, blurLevel: 2 },
  grading: { enabled: false, brightness: 1, contrast: 1, saturation: 1, tint: [1, 1, 1] },
  vignette: { enabled: false, intensity: 0.5, inner: 0.3, outer: 0.75, curvature: 1 },
  fringing: { enabled: false, intensity: 0.5 },
};

const round = (x: number): number => Number(x.toFixed(DIGITS)) + 0;
/** Turn by 180 degrees around z: from the frame of the scene to that of SuperSplat, and back. */
const turn = (v: Vec3): Vec3 => [round(-v[0]), round(-v[1]), round(v[2])];

/** Return settings of any kind as a draft. `aspect` is of the window whose height angles of the scene's frame cover. */
export function draftOf(settings: unknown, aspect: number): Draft {
  const all = fields(settings) ?? {}, own = all.frame === "scene";
  const place = (value: unknown): Vec3 | null => {
    const at = vector(value, 1e6);
    return at && (own ? turn(at) : at);
  };
  const pose = (value: unknown): Pose | null => {
    const it = fields(value), [position, target] = [place(it?.position), place(it?.target)];
    const fov = typeof it?.fov === "number" ? it.fov : 60;
    return position && target ? { position, target, fov: own ? longer(fov, aspect) : fov } : null;
  };
  const placeless = list(all.annotations).map(fields).filter((each) => each && !vector(each.position)); // views with a name
  const views = [...(all.version === 2 ? list(all.cameras) : [all.camera]), ...placeless.map((each) => (
    { ...fields(each?.camera), name: each?.title }))];
  const cameras = views.flatMap((each) => {
    const initial = pose(fields(each)?.initial ?? each), name = fields(each)?.name;
    return initial ? [{ ...(typeof name === "string" ? { name } : {}), initial }] : [];
  });
  const annotations = list(all.annotations).flatMap((each): Spot[] => {
    const it = fields(each), position = place(it?.position), initial = pose(fields(it?.camera)?.initial);
    const said = (value: unknown): string => (typeof value === "string" ? value : "");
    return position && initial ? [{
      ...it, position, title: said(it?.title), text: said(it?.text), extras: fields(it?.extras) ?? {}, camera: { initial },
    }] : [];
  });
  const { frame: _, camera: __, gsvis: ___, ...rest } = all;
  return {
    tonemapping: "none", highPrecisionRendering: false, postEffectSettings: EFFECTS, ...rest, version: 2,
    background: { color: [0, 0, 0], ...fields(all.background) }, cameras, annotations,
    animTracks: list(all.animTracks).map((each) => (own ? turned(each, aspect) : each)), startMode: typeof all.startMode === "string" ? all.startMode : "default",
  };
}

/** Return a track of the scene's frame in that of SuperSplat. */
function turned(track: unknown, aspect: number): unknown {
  const it = fields(track), keys = fields(it?.keyframes), values = fields(keys?.values);
  if (!values) return track;
  const places = (value: unknown): number[] => list(value).map((x, k) => (k % 3 < 2 ? -Number(x) : Number(x)));
  const fov = values.fov === undefined ? {} : { fov: list(values.fov).map((x) => longer(Number(x), aspect)) };
  const turnedValues = { ...values, position: places(values.position), target: places(values.target), ...fov };
  return { ...it, keyframes: { ...keys, values: turnedValues } };
}

/** Return the angle of the longer side of a window, from that of its height. */
function longer(fov: number, aspect: number): number {
  return round((2 / DEGREES) * Math.atan(Math.tan((fov * DEGREES) / 2) * Math.max(aspect, 1)));
}

/** Return a track through all views, `seconds` from one to the next. */
export function trackOf(cameras: Draft["cameras"], seconds: number, loops: boolean): Fields {
  const poses = cameras.map(({ initial }) => initial), steps = Math.max(1, Math.round(seconds * RATE));
  return {
    name: "views", duration: (steps * (poses.length - (loops ? 0 : 1))) / RATE, frameRate: RATE, interpolation: "spline",
    loopMode: loops ? "repeat" : "none", smoothness: 1,
    keyframes: {
      times: poses.map((_, k) => k * steps),
      values: {
        position: poses.flatMap(({ position }) => position), target: poses.flatMap(({ target }) => target),
        fov: poses.map(({ fov }) => fov),
      },
    },
  };
}

class Author {
  readonly element = make("div", { class: "author" });
  readonly #key: string;
  readonly #undone = make("button", { type: "button", class: "text" }, icon("back"), textOfPage("author.undo"));
  readonly #first: Draft; // of the settings that the page came with
  #draft: Draft;
  #before: Draft[] = [];
  #placing = false;

  constructor(private readonly stage: Stage) {
    this.#key = `gsvis-author ${location.pathname} ${stage.name}`;
    const kept = this.#read();
    this.#first = this.#published();
    this.#draft = kept ?? this.#first;
    on(this.#undone, "click", () => this.#undo());
    stage.clicks((x, y) => this.#click(x, y));
    this.#fill();
    if (kept) this.#show();
  }

  #published(): Draft {
    const { width, height } = this.stage.look();
    const draft = draftOf(this.stage.settings(), width / height);
    if (fields(fields(this.stage.settings())?.background)?.color) return draft;
    const shown = getComputedStyle(document.body).backgroundColor.match(/\d+/g) ?? []; // what the page shows without one
    return { ...draft, background: { ...draft.background, color: [0, 1, 2].map((k) => round(Number(shown[k] ?? 0) / 255)) as Vec3 } };
  }

  #read(): Draft | null {
    try {
      const kept = localStorage.getItem(this.#key);
      return kept === null ? null : draftOf(JSON.parse(kept), 1);
    } catch {
      return null; // storage is switched off, or holds something else
    }
  }

  #show(): void {
    void this.stage.apply(this.#draft);
  }

  /** Change the draft, keep it, and show it in the page; lists are built anew where `lists`. */
  #change(draft: Draft, lists = true): void {
    this.#before = [...this.#before, this.#draft].slice(-MOST_STEPS);
    this.#take(draft, lists);
  }

  #take(draft: Draft, lists: boolean): void {
    this.#draft = draft;
    try {
      localStorage.setItem(this.#key, JSON.stringify(draft));
    } catch {
      this.stage.say(textOfPage("author.unkept"));
    }
    this.#show();
    if (lists) this.#fill();
    this.#undone.disabled = this.#before.length === 0;
  }

  /** Change one entry; its fields stay on the page, since somebody types in them. */
  #edit(name: "cameras" | "annotations", k: number, change: Fields): void {
    const entries = this.#draft[name].map((each, i) => (i === k ? { ...each, ...change } : each));
    this.#change({ ...this.#draft, [name]: entries }, false);
  }

  #undo(): void {
    const draft = this.#before.pop();
    if (draft) this.#take(draft, true);
  }

  /** Return where the page looks from. */
  #pose(): Pose {
    const { view, width, height } = this.stage.look();
    return { position: turn(view.eye), target: turn(view.to), fov: longer(view.fov, width / height) };
  }

  async #place(x: number, y: number): Promise<void> {
    const found = await this.stage.find(x, y), { annotations } = this.#draft;
    if (!found) return this.stage.say(textOfPage("author.nothing"));
    const title = textOfPage("author.spot", { number: annotations.length + 1 });
    const spot: Spot = { position: turn(found.position), title, text: "", extras: {}, camera: { initial: this.#pose() } };
    this.#change({ ...this.#draft, annotations: [...annotations, spot] });
    this.element.querySelector<HTMLInputElement>(".spot-edit:last-child input")?.select();
  }

  #click(x: number, y: number): boolean {
    if (!this.#placing || !this.element.isConnected) return false;
    void this.#place(x, y);
    return true;
  }

  /** Build all parts anew, and keep the focus where it was. */
  #fill(): void {
    const focused = this.element.contains(document.activeElement) ? document.activeElement?.getAttribute("data-at") : null;
    this.element.replaceChildren(this.#views(), this.#spots(), this.#background(), this.#path(), this.#end());
    this.#undone.disabled = this.#before.length === 0;
    const find = (at: string): HTMLElement | null => this.element.querySelector(`[data-at="${at}"]:enabled`);
    if (focused) (find(CSS.escape(focused)) ?? find("add"))?.focus();
  }

  #views(): HTMLElement {
    const { cameras } = this.#draft, set = (next: Draft["cameras"]): void => this.#change({ ...this.#draft, cameras: next });
    const rows = cameras.map((camera, k) => {
      const label = camera.name ?? textOfPage("author.view", { number: k + 1 });
      const name = this.#field(textOfPage("author.name", { label }), label, (typed) => (
        this.#edit("cameras", k, { name: typed })));
      const go = tool("next", textOfPage("author.go", { label }), `go-${k}`, () => (
        this.stage.go({ eye: turn(camera.initial.position), to: turn(camera.initial.target), fov: camera.initial.fov, longer: true })));
      const up = tool("up", textOfPage("author.up", { label }), `up-${k}`, () => set(moved(cameras, k)));
      up.disabled = k === 0;
      const drop = tool("close", textOfPage("author.delete", { label }), `drop-${k}`, () => set(cameras.filter((_, i) => i !== k)));
      return make("li", {}, name, go, up, drop);
    });
    return section(textOfPage("author.views"), make("p", { class: "legend" }, textOfPage("author.first")),
      make("ol", { class: "rows" }, ...rows),
      button(textOfPage("author.add"), "add", () => set([...cameras, { initial: this.#pose() }])));
  }

  #spots(): HTMLElement {
    const { annotations } = this.#draft;
    const set = (next: Spot[]): void => this.#change({ ...this.#draft, annotations: next });
    const rows = annotations.map((spot, k) => {
      const label = spot.title || textOfPage("author.spot", { number: k + 1 });
      const field = (name: "title" | "text", says: string): HTMLElement => (
        this.#field(says, spot[name], (typed) => this.#edit("annotations", k, { [name]: typed }), name === "text"));
      const link = this.#field(textOfPage("author.link", { label }), String(spot.extras.link ?? ""), (typed) => (
        this.#edit("annotations", k, { extras: { ...spot.extras, link: typed } })));
      const drop = tool("close", textOfPage("author.delete", { label }), `spot-${k}`, () => set(annotations.filter((_, i) => i !== k)));
      return make("li", { class: "spot-edit" }, make("div", {}, field("title", textOfPage("author.title", { label })), drop),
        field("text", textOfPage("author.text", { label })), link);
    });
    const input = make("input", { type: "checkbox", role: "switch", "data-at": "clicks" });
    input.checked = this.#placing;
    on(input, "change", () => { this.#placing = input.checked; });
    return section(textOfPage("author.spots"), make("ol", { class: "rows" }, ...rows),
      make("label", { class: "switch" }, make("span", {}, textOfPage("author.clicks")), input),
      button(textOfPage("author.middle"), "middle", () => {
        const { width, height } = this.stage.look();
        void this.#place(width / 2, height / 2);
      }));
  }

  #background(): HTMLElement {
    const hex = (c: number): string => Math.round(255 * Math.min(Math.max(c, 0), 1)).toString(16).padStart(2, "0");
    const input = make("input", { type: "color", value: `#${this.#draft.background.color.map(hex).join("")}` });
    on(input, "change", () => {
      const color = [1, 3, 5].map((at) => round(parseInt(input.value.slice(at, at + 2), 16) / 255)) as Vec3;
      this.#change({ ...this.#draft, background: { ...this.#draft.background, color } }, false);
    });
    return section(textOfPage("author.background"), make("label", { class: "switch" }, make("span", {}, textOfPage("author.color")), input));
  }

  #path(): HTMLElement {
    const { animTracks: [track], cameras, startMode } = this.#draft, loop = fields(track)?.loopMode === "repeat";
    const seconds = make("input", { type: "number", min: 1, max: 60, step: 1, value: 4, "data-at": "seconds" });
    const make_ = (loops: boolean): void => this.#change({ ...this.#draft, animTracks: [trackOf(cameras, Number(seconds.value) || 4, loops)] });
    const parts = [
      make("label", { class: "switch" }, make("span", {}, textOfPage("author.seconds")), seconds),
      button(textOfPage("author.path"), "path", () => make_(loop)),
    ];
    parts[1].toggleAttribute("disabled", cameras.length < 2);
    const toggles: HTMLElement[] = track ? [
      this.#toggle("author.loops", "loops", loop, (on) => make_(on)),
      this.#toggle("author.plays", "plays", startMode === "animTrack", (on) => (
        this.#change({ ...this.#draft, startMode: on ? "animTrack" : "default" }))),
      button(textOfPage("author.unpath"), "unpath", () => this.#change({ ...this.#draft, animTracks: [], startMode: "default" })),
    ] : [];
    return section(textOfPage("author.paths"), ...parts, ...toggles);
  }

  #toggle(key: "author.loops" | "author.plays", at: string, on_: boolean, change: (on: boolean) => void): HTMLElement {
    const input = make("input", { type: "checkbox", role: "switch", "data-at": at });
    input.checked = on_;
    on(input, "change", () => change(input.checked));
    return make("label", { class: "switch" }, make("span", {}, textOfPage(key)), input);
  }

  #end(): HTMLElement {
    const clear = button(textOfPage("author.clear"), "clear", () => {
      this.#change(this.#first);
      localStorage.removeItem(this.#key);
    });
    return make("section", { class: "actions" }, this.#undone, clear,
      button(textOfPage("author.download"), "download", () => this.#download(), "primary"));
  }

  #download(): void {
    const url = URL.createObjectURL(new Blob([`${JSON.stringify(this.#draft, null, 1)}\n`], { type: "application/json" }));
    make("a", { href: url, download: "settings.json" }).click();
    setTimeout(() => URL.revokeObjectURL(url), 10_000);
  }

  #field(label: string, value: string, change: (typed: string) => void, long = false): HTMLElement {
    const input = long ? make("textarea", { rows: 2, "aria-label": label, placeholder: label, "data-at": label })
      : make("input", { type: "text", "aria-label": label, placeholder: label, "data-at": label });
    input.value = value;
    input.addEventListener("change", () => change(input.value.trim()));
    return input;
  }
}

function moved<T>(all: readonly T[], k: number): T[] {
  return [...all.slice(0, k - 1), all[k], all[k - 1], ...all.slice(k + 1)];
}

function section(title: string, ...content: Node[]): HTMLElement {
  return make("section", {}, make("h3", {}, title), ...content);
}

function button(label: string, at: string, run: () => void, look = "text"): HTMLButtonElement {
  const made = make("button", { type: "button", class: look, "data-at": at }, label);
  on(made, "click", run);
  return made;
}

function tool(name: IconName, label: string, at: string, run: () => void): HTMLButtonElement {
  const made = make("button", { type: "button", class: "tool", "aria-label": label, title: label, "data-at": at }, icon(name));
  on(made, "click", run);
  return made;
}

offer("author", (stage) => new Author(stage).element);
