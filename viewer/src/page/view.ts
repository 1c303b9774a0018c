// The page of one scene: puts canvas, navigation and panels together, and keeps them in step with the viewer.

import type { Header, Source } from "../core/types.ts";
import { Actions } from "./actions.ts";
import type { PageAddress, SceneAddress } from "./address.ts";
import { Dock, TitleBar, toolBar } from "./bars.ts";
import { guessMeter, rigFromView, survey } from "./begin.ts";
import type { Surroundings } from "./begin.ts";
import { defineActions } from "./commands.ts";
import type { Commands } from "./commands.ts";
import { make, meta } from "./dom.ts";
import { Drive } from "./drive.ts";
import { Extras } from "./extras.ts";
import { Facts } from "./facts.ts";
import { FloorGround } from "./ground.ts";
import { Help } from "./help.ts";
import { Inspector } from "./inspector.ts";
import { colorOf } from "./format.ts";
import { copyLink, offersWebGL, reasonOf, savePicture, toggleFull } from "./keep.ts";
import { describeState, explainFailure, messageOf } from "./messages.ts";
import { MODES } from "./navigator.ts";
import type { Mode, Navigator } from "./navigator.ts";
import { Notices } from "./notice.ts";
import { Overlay } from "./overlay.ts";
import { Panel } from "./panel.ts";
import { QualityChoice } from "./quality.ts";
import { Places } from "./places.ts";
import { DEGREES, pivot, rotation } from "./rig.ts";
import { factsOf, holdPoses, rest } from "./scene.ts";
import { Side } from "./side.ts";
import type { Stage } from "./stage.ts";
import { StatisticsCard } from "./statistics.ts";
import { ThemeChoice } from "./theme.ts";
import { frameFromUp } from "./vector.ts";
import type { PageCamera, ViewerLike, ViewerOptions } from "./viewer-like.ts";
import { WalkGround } from "./walk.ts";
import { text } from "./words.ts";
import { Immersion } from "./xr.ts";

export interface Core {
  makeViewer(canvas: HTMLCanvasElement, options: ViewerOptions): ViewerLike;
  makeSource(scene: SceneAddress, token: string | null): Source;
}

const AHEAD_MS = 200; // most time for the first view to be sent before the page prepares to draw
const LOOKS_MS = 250; // between two looks at the statistics
const BLANK_LOOKS = 8; // until the page says that nothing is to be seen
const MISSES = 4; // waits without any answer until the page says that none may come
const CLIMB_M = 0.7; // from square to square of a floor

export class ViewPage {
  readonly #root: HTMLElement;
  #canvas = make("canvas");
  #viewer: ViewerLike | null = null;
  #source: Source | null = null;
  #header: Header | null = null;
  #facts: Facts;
  #surroundings: Surroundings = { floor: null, cells: null, poses: [] };
  #takeClick: (x: number, y: number) => boolean = () => false;
  #ready: Promise<unknown>;
  #misses = 0; // waits since the scene was opened, before its server has said anything
  #blank = 0; // looks at a complete picture without a Gaussian
  #focused = false;
  #still: PageCamera | null = null; // the camera of the picture that stays until all of the scene is here
  #release: () => void = () => undefined;
  readonly #followers: ((resting: boolean) => void)[] = [];
  #walls: Facts | null = null; // asked for walls
  #token: string | null;

  readonly #actions = new Actions();
  readonly #theme: ThemeChoice;
  readonly #title: TitleBar;
  readonly #dock: Dock;
  readonly #side = new Side(() => this.#actions.changed());
  readonly #panel: Panel;
  readonly #figures = new StatisticsCard();
  readonly #help: Help;
  readonly #notices: Notices;
  readonly #immersion = new Immersion(() => this.#actions.changed());
  readonly #overlay = new Overlay();
  readonly #spoken = make("p", { class: "hidden", role: "status", "aria-live": "polite" });
  readonly #inspector: Inspector;
  readonly #drive: Drive;
  readonly #places: Places;
  readonly #extras: Extras;
  readonly #navigator: Navigator;
  readonly #quality: QualityChoice;

  constructor(private scene: SceneAddress, private readonly page: PageAddress, private readonly core: Core) {
    this.#root = document.querySelector("main") ?? document.body.appendChild(make("main"));
    this.#token = page.token;
    this.#facts = factsOf(scene);
    this.#quality = new QualityChoice(page.quality, page.budget);
    this.#theme = new ThemeChoice(() => this.#showBackground());
    this.#notices = new Notices(
      { retry: () => this.#tryAgain(), token: (token) => this.#enter(token) },
    );
    this.#drive = new Drive({
      actions: this.#actions, moved: () => (this.#quality.move(true), this.#sendCamera(), void this.#learnWalls()),
      rested: () => (this.#quality.move(false), this.#panel.refresh(), this.#actions.changed(), this.#places.write(), this.#lead(true)),
      click: (x, y, withAlt) => void (this.#takeClick(x, y) ? undefined : this.#inspector.on || (withAlt && !this.page.visitor) ? this.#inspector.inspect(x, y) : undefined),
      doubleClick: (x, y) => void this.#goTo(x, y), view: (index) => this.#places.goToView(index),
      escape: () => this.#side.close() || this.#stopInspecting(),
    });
    this.#navigator = this.#drive.navigator;
    this.#places = new Places({
      navigator: this.#navigator, setMode: (mode) => this.#setMode(mode), wake: () => this.#drive.wake(),
      jumped: () => this.#sendCamera(), say: (line) => this.#notices.say(line),
      went: (view, index) => (this.#speak(text("say.view", { name: view.name ?? index + 1 })), this.#actions.changed()),
    });
    this.#inspector = new Inspector({
      side: this.#side, facts: () => this.#facts, viewer: () => this.#viewer, header: () => this.#header,
      place: () => ({ rig: this.#navigator.shown, frame: this.#navigator.frame }), speak: (text) => this.#speak(text),
    });
    defineActions(this.#actions, this.#commands());
    this.#title = new TitleBar(scene.name, scene.root);
    this.#dock = new Dock(this.#actions, {
      mode: () => this.#navigator.mode, setMode: (mode) => this.#setMode(mode),
      views: () => this.#places,
    });
    this.#extras = new Extras({
      side: this.#side, overlay: this.#overlay.element, dock: this.#dock.element, stage: () => this.stage,
      say: (line) => this.#notices.say(line),
    });
    this.#panel = new Panel({
      viewer: () => this.#viewer, actions: this.#actions, theme: this.#theme,
      fov: {
        degrees: () => this.#navigator.shown.fovY / DEGREES,
        choose: (degrees) => (this.#navigator.setFov(degrees * DEGREES), this.#drive.wake()),
      },
      served: () => this.#facts.known, marks: () => this.#facts.marks(),
      cells: {
        known: () => this.#overlay.known, shown: () => !this.#overlay.element.hidden,
        show: (shown) => this.#showCells(shown),
      },
      quality: this.#quality,
      pace: { factor: () => this.#navigator.pace, choose: (factor) => void (this.#navigator.pace = factor) },
    });
    this.#help = new Help(this.#actions);
    this.#build();
    this.#ready = this.#prepare();
    void this.#open();
    setInterval(() => this.#look(), LOOKS_MS);
  }

  #build(): void {
    const poster = this.#root.querySelector(".poster");
    document.title = meta("title") ?? text("page.title", { name: this.scene.name });
    if (this.page.bare) document.documentElement.dataset.bare = "";
    this.#root.replaceChildren(
      this.#canvas, this.#overlay.element, ...(poster ? [poster] : []), this.#inspector.mark, this.#title.element, toolBar(this.#actions),
      this.#figures.element, this.#side.element,
      this.#drive.joystick.element, this.#dock.element, this.#notices.line, this.#notices.card, this.#spoken,
      make(
        "p", { id: "keys", class: "hidden" },
        text("page.keys"),
      ), this.#help.element,
    );
    this.#setMode("orbit");
    this.#panel.fill(null);
    this.#actions.watch(() => this.#dock.refresh());
    window.addEventListener("hashchange", () => this.#places.follow());
    document.addEventListener("fullscreenchange", () => this.#actions.changed());
    window.addEventListener("resize", () => this.#resize());
  }

  #resize(): void {
    this.#viewer?.resize();
    this.#places.fit();
    this.#drawCells();
    this.#lead(true);
  }

  /** Load settings and facts; neither can stop the scene from being shown. */
  async #prepare(): Promise<void> {
    const known = survey(this.#facts);
    [this.#surroundings] = await Promise.all([known, this.#extras.load(this.page.settings)]);
    this.#overlay.set(this.#surroundings.cells);
  }

  /**
   * Open the scene in a fresh canvas. The first view is on its way before the page prepares to draw: that holds it up
   * for a while, and takes nothing that has not come.
   */
  async #open(): Promise<void> {
    this.#header = null;
    this.#misses = 0;
    const before = this.#canvas;
    before.before((this.#canvas = make("canvas", {
      tabindex: 0, role: "application", "aria-label": text("page.scene", { name: this.scene.name }), "aria-describedby": "keys",
    })));
    if (this.#still === null) before.remove();
    else keepStill(before);
    this.#drive.listen(this.#canvas);
    const { source, header, release } = holdPoses(this.core.makeSource(this.scene, this.#token));
    [this.#source, this.#release] = [source, release];
    this.#sendCamera();
    await Promise.race([header.then((known) => this.#takeHeader(known, source)), rest(AHEAD_MS)]);
    if (this.#source !== source) return;
    try {
      this.#viewer = this.core.makeViewer(this.#canvas, {
        source, background: this.#background, camera: this.#camera, patient: this.#still !== null,
      });
    } catch (error) {
      source.close();
      const message = error instanceof Error ? error.message : String(error);
      this.#showState("failed", text("state.failed"), 0);
      this.#notices.stop(offersWebGL() ? explainFailure(message) : { ...messageOf("webgl"), detail: message });
      return;
    }
    const viewer = this.#viewer;
    viewer.addEventListener("header", () => void (viewer.header && this.#takeHeader(viewer.header, source)));
    viewer.addEventListener("state", () => this.#takeState());
    viewer.addEventListener("frame", () => this.#quality.drawn(performance.now()));
    this.#quality.use(viewer);
    viewer.addEventListener("contextlost", () => this.#notices.say(text("say.context"), true));
    viewer.addEventListener("contextrestored", () => this.#notices.say(""));
    viewer.addEventListener("problem", (event) => this.#notices.say(
      viewer.statistics.dropped ? text("say.memory", { count: viewer.statistics.gaussians })
        : text("say.broken", { reason: event instanceof CustomEvent ? String(event.detail) : "" }),
    ));
    this.#takeState();
    this.#fill(this.#header);
  }

  /** Fill the options for a scene; visitors need none that explain it. */
  #fill(header: Header | null): void {
    this.#panel.fill(this.page.visitor ? null : header);
  }

  /** Begin anew where a visitor asked for it, from a button that is gone then. */
  #tryAgain(): void {
    this.#uncover();
    this.#restart();
    this.#canvas.focus();
  }

  #restart(): void {
    this.#source?.close();
    this.#viewer?.dispose();
    this.#viewer = null;
    this.#notices.clear();
    void this.#open();
  }

  /** Try a token. A server of pages needs it for the scripts of Workers too: it makes a cookie of the one in an address. */
  #enter(token: string): void {
    const query = new URLSearchParams(location.search);
    query.set("token", token);
    if (this.scene.root) location.search = `${query}`;
    else ((this.#token = token), this.#tryAgain());
  }

  /** Show the same scene from elsewhere: a stream after it has been prepared, or all of it after a sample; the view stays. */
  change(scene: SceneAddress): void {
    this.scene = scene;
    this.#facts = factsOf(scene);
    this.#ready = this.#prepare();
    if (scene.kind === "static" && this.#viewer?.statistics.firstImageSeconds) this.#still = this.#camera;
    this.#restart();
    if (scene.kind === "stream") this.#notices.say(text("say.prepared"));
  }

  async #takeHeader(header: Header, source: Source): Promise<void> {
    await this.#ready;
    // connected again: all stays as it is
    if (this.#source !== source || this.#header?.identity === header.identity) return;
    [this.#header, this.#walls] = [header, null];
    const navigator = this.#navigator, surroundings = this.#surroundings;
    navigator.reframe(frameFromUp(this.#places.up ?? header.up));
    navigator.meter = guessMeter(header, surroundings.cells);
    if (surroundings.floor) navigator.standOn(new FloorGround(surroundings.floor, CLIMB_M * navigator.meter));
    if (!this.#places.isBegun) this.#begin();
    this.#sendCamera();
    this.#release();
    this.#fill(header);
    this.#actions.changed();
    this.#showBackground();
  }

  #begin(): void {
    const { settings, player } = this.#extras;
    const plays = settings.plays && location.hash.length < 2 && !this.page.still && !this.#navigator.calm;
    const first = this.#places.begin(settings.views, this.#surroundings);
    this.#focused = first.focused;
    this.#setMode(first.mode);
    if (first.problem) this.#notices.say(first.problem);
    if (plays) player?.play();
    if (this.page.authors) void this.#extras.toggleAuthor();
  }

  /** Find out how far away lies what is looked at, where no view has said it. */
  async #focus(): Promise<void> {
    if (this.#focused || !this.#viewer) return;
    this.#focused = true;
    const pick = await this.#viewer.pick(this.#canvas.clientWidth / 2, this.#canvas.clientHeight / 2);
    if (pick) this.#navigator.refocus(pick.depth);
    else this.#focused = false;
  }

  #takeState(): void {
    const state = this.#viewer?.statistics.state;
    if (!state || !this.#viewer) return;
    document.documentElement.dataset.state = state.kind;
    if (state.kind === "failed") {
      const code = "code" in state && typeof state.code === "number" ? state.code : undefined;
      this.#notices.stop(explainFailure(state.message, code));
    } else if (state.kind === "waiting" && !this.#header) {
      if (++this.#misses === MISSES) this.#notices.stop({ ...messageOf("silent"), detail: state.message });
    } else if (this.#header || state.kind !== "connecting") {
      this.#notices.clear();
    }
    if (state.kind === "waiting" && this.#header) this.#notices.say(
      text("say.lost"), true,
    );
    else if (state.kind !== "connecting" && this.#notices.line.textContent === text("say.lost")) {
      this.#notices.say(state.kind === "failed" ? "" : text("say.again"));
    }
    if ((state.kind === "streaming" || state.kind === "complete") && "message" in state && state.message) {
      this.#notices.say(text("say.missing", { reason: String(state.message) }));
    }
    if (state.kind === "complete") void this.#focus();
    if (state.kind === "complete" && !("message" in state && state.message)) this.#speak(text("say.complete"));
    this.#look();
  }

  /** Show what has changed in the figures. */
  #look(): void {
    if (!this.#viewer || document.hidden) return;
    const now = this.#viewer.statistics;
    if (now.firstImageSeconds !== null) this.#uncover();
    this.#showState(
      now.state.kind, describeState(now.state, this.page.visitor ? null : now.gaussians), this.#header ? now.gaussians / this.#header.gaussians : 0,
    );
    const isBlank = now.state.kind === "complete" && !now.drawn && this.#still === null; // else it is not sorted yet
    this.#blank = isBlank ? this.#blank + 1 : 0;
    if (this.#blank === BLANK_LOOKS) this.#notices.say(text("say.nothing"));
    if (!this.#figures.element.hidden) this.#figures.show(now, this.#header);
  }

  /** Take away what covers the canvas until there is a picture in it. */
  #uncover(): void {
    this.#root.querySelector(".poster")?.remove();
    this.#still = null;
    if (this.#viewer) this.#viewer.patient = false;
  }

  #showState(kind: string, text: string, share: number): void {
    this.#title.show(kind, text, share);
    document.documentElement.dataset.state = kind;
  }

  get #background(): [number, number, number] {
    return colorOf(meta("background")) ?? this.#extras.settings.background ?? this.#theme.background;
  }

  #showBackground(): void {
    if (this.#viewer) this.#viewer.background = this.#background;
  }

  // Motion

  get #camera(): PageCamera {
    const { shown, frame } = this.#navigator;
    return { position: shown.eye, rotation: rotation(shown, frame), fovY: shown.fovY };
  }

  #sendCamera(): void {
    const camera = this.#camera, up = Math.tan(camera.fovY / 2);
    if (!this.#viewer) {
      const side = (up * this.#canvas.clientWidth) / (this.#canvas.clientHeight || 1);
      this.#source?.view({ left: side, right: side, up, down: up });
      this.#source?.pose(camera);
    }
    if (!this.#viewer || !this.#places.isBegun) return;
    if (this.#still !== null && !isSame(this.#still, camera)) this.#uncover(); // somebody moves
    this.#viewer.camera = camera;
    this.#inspector.mark.hidden = true;
    this.#drawCells();
    this.#lead(false);
  }

  #lead(resting: boolean): void {
    for (const each of this.#followers) each(resting);
  }

  #showCells(shown: boolean): void {
    this.#overlay.element.hidden = !shown;
    this.#drawCells();
  }

  #drawCells(): void {
    this.#overlay.draw(this.#navigator.shown, this.#navigator.frame);
  }

  /** What scripts of their own see of this page. */
  get stage(): Stage {
    const navigator = this.#navigator;
    return {
      name: this.scene.name, visitor: this.page.visitor, permits: this.page.permits,
      look: () => {
        const { shown, frame, mode } = navigator, { state, gaussians, firstImageSeconds } = this.#viewer?.statistics ?? {};
        return {
          view: { eye: shown.eye, to: pivot(shown, frame), fov: shown.fovY / DEGREES }, up: frame.up, mode,
          width: this.#canvas.clientWidth, height: this.#canvas.clientHeight, state: state?.kind ?? "connecting",
          message: state && "message" in state ? String(state.message) : "", gaussians: gaussians ?? 0,
          of: this.#header?.gaussians ?? 0, drawn: firstImageSeconds !== null && firstImageSeconds !== undefined,
          led: navigator.track !== null,
        };
      },
      go: (view, now) => this.#places.go(view, now), turn: (mode) => this.#setMode(mode),
      lead: (track) => {
        navigator.track = track && ((seconds) => {
          const view = track(seconds);
          return view && rigFromView(view, navigator.frame);
        });
        this.#drive.wake();
      },
      player: () => this.#extras.player,
      find: async (x, y) => (await this.#viewer?.pick(x, y)) ?? null,
      picture: () => this.#viewer?.screenshot() ?? Promise.reject(new Error(text("say.undrawn"))),
      settings: () => this.#extras.said, clicks: (take) => void (this.#takeClick = take),
      apply: async (said) => {
        await this.#extras.apply(said);
        this.#places.take(this.#extras.settings.views);
        this.#showBackground();
        this.#actions.changed();
      },
      refine: (quality, budget) => (this.#quality.choose(quality, budget), this.#panel.refresh()),
      say: (line) => this.#notices.say(line), follow: (each) => void this.#followers.push(each),
    };
  }

  #setMode(mode: Mode): void {
    const chosen = mode !== this.#navigator.mode;
    if (mode === "orbit" && chosen) this.#focused = false;
    this.#navigator.setMode(mode);
    if (chosen) void this.#learnWalls();
    document.documentElement.dataset.mode = mode;
    this.#speak(text("mode.spoken", { mode: text(`mode.${mode}`) }));
    if (this.#places.isBegun) {
      void this.#focus();
      this.#places.write();
    }
    this.#dock.refresh();
    this.#drive.wake();
  }

  /** Let a walker stop at walls; of scenes without any floor say that nothing is known of them. */
  async #learnWalls(): Promise<void> {
    const facts = this.#facts;
    if (this.#navigator.mode !== "walk" || !this.#places.isBegun || this.#walls === facts) return;
    this.#walls = facts;
    const grid = await facts.walk();
    if (this.#walls !== facts) return;
    if (grid) this.#navigator.standOn(new WalkGround(grid));
    else if (!this.#surroundings.floor) this.#notices.say(text("say.walls"));
    this.#drive.wake();
  }

  async #goTo(x: number, y: number): Promise<void> {
    const pick = await this.#viewer?.pick(x, y);
    if (!pick) return;
    this.#navigator.goTo(pick.position);
    this.#drive.wake();
  }

  #speak(text: string): void {
    this.#spoken.textContent = text;
  }

  #stopInspecting(): boolean {
    if (!this.#inspector.on) return false;
    this.#actions.run("inspect");
    return true;
  }

  /** What buttons and keys can ask for. */
  #commands(): Commands {
    const root = document.documentElement, say = (line: string): void => this.#notices.say(line);
    return {
      explains: () => !this.page.visitor,
      inspecting: () => this.#inspector.on,
      toggleInspecting: () => {
        this.#inspector.on = !this.#inspector.on;
        this.#canvas.classList.toggle("inspecting", this.#inspector.on);
        this.#notices.say(this.#inspector.on ? text("say.inspect") : "");
      },
      authors: () => this.page.authors,
      authorShown: () => this.#side.shows("author"),
      toggleAuthor: () => void this.#extras.toggleAuthor(),
      optionsShown: () => this.#side.shows("options"),
      toggleOptions: () => {
        if (this.#side.shows("options")) this.#side.close();
        else this.#side.open("options", text("action.options"), this.#panel.element);
        this.#panel.refresh();
      },
      statisticsShown: () => !this.#figures.element.hidden,
      toggleStatistics: () => {
        this.#figures.element.hidden = !this.#figures.element.hidden;
        this.#look();
      },
      share: () => void (this.#places.write(), copyLink(say)),
      savePicture: () => void savePicture(this.#viewer, this.scene.name, say),
      cellsKnown: () => this.#overlay.known,
      toggleCells: () => {
        this.#showCells(Boolean(this.#overlay.element.hidden));
        this.#panel.refresh();
      },
      nextPaint: () => {
        void this.#panel.nextPaint().then((label) => label && this.#notices.say(text("paint.next", { label })));
      },
      goHome: () => this.#places.goHome(),
      views: () => this.#places.count,
      stepView: (by) => this.#places.step(by),
      nextMode: () => this.#setMode(MODES[(MODES.indexOf(this.#navigator.mode) + 1) % MODES.length]),
      animated: () => this.#extras.player !== null,
      togglePlaying: () => this.#extras.togglePlaying(),
      toggleTheme: () => {
        this.#theme.choose(this.#theme.dark ? "light" : "dark");
        this.#panel.refresh();
      },
      toggleBare: () => {
        if (root.dataset.bare === undefined) root.dataset.bare = "";
        else delete root.dataset.bare;
      },
      vrOffered: () => this.#immersion.offered && this.#viewer?.enterXr !== undefined,
      vrOn: () => this.#immersion.on,
      toggleVr: () => void this.#toggleVr(),
      help: () => this.#help.open(),
      toggleFull: () => void toggleFull(say),
    };
  }

  async #toggleVr(): Promise<void> {
    try {
      await this.#immersion.toggle(async (session) => {
        this.#actions.changed();
        await this.#viewer?.enterXr?.(session);
      });
    } catch (error) {
      this.#notices.say(text("say.headset", { reason: reasonOf(error) }).trim());
    }
    this.#actions.changed();
  }
}

/** Leave the last picture of a canvas on the page, as a cover. */
function keepStill(canvas: HTMLCanvasElement): void {
  for (const name of ["tabindex", "role", "aria-label", "aria-describedby"]) canvas.removeAttribute(name);
  canvas.className = "poster";
  canvas.ariaHidden = "true";
}

/** Return whether two cameras are the same but for rounding. */
function isSame(one: PageCamera, other: PageCamera): boolean {
  const numbers = [...other.position, ...other.rotation, other.fovY];
  return [...one.position, ...one.rotation, one.fovY].every((v, k) => Math.abs(v - numbers[k]) <= 1e-6 * (1 + Math.abs(v)));
}
