// The controls of an animation: play and pause, its position by mouse, touch and keys, its time, and whether it repeats.
// A script of its own, with the animation: pages load it where their settings have a track.

import { make, on, setText } from "./dom.ts";
import { icon } from "./icons.ts";
import { offer, textOfPage } from "./parts.ts";
import type { Player, Stage } from "./stage.ts";
import { readTour } from "./tour.ts";
import type { Loops, Tour } from "./tour.ts";
import { clamp } from "./vector.ts";

const ARROW_SECONDS = 1;
const PAGE_SHARE = 0.1; // of the duration, by a page key
const IDLE_MS = 3000; // without a hand, after which visitors see the picture alone
const STIRS = ["pointermove", "pointerdown", "keydown"] as const;

class Timeline implements Player {
  readonly bar = make("div", { class: "timeline", role: "group", "aria-label": textOfPage("timeline.title") });
  readonly duration: number;
  readonly loops: Loops;
  readonly #button: HTMLButtonElement;
  readonly #slider: HTMLInputElement;
  readonly #time = make("p");
  #passed = 0; // seconds since the start; loops are not taken off
  #grasped = false; // was playing when somebody took the slider
  #shown: boolean | null = null; // whether the button shows it as playing
  #timer = 0;

  constructor(private readonly stage: Stage, private readonly tour: Tour) {
    this.duration = tour.duration;
    this.loops = tour.loops;
    const label = textOfPage("action.play"), hint = textOfPage("action.hint", { label, key: "K" });
    this.#button = make("button", {
      type: "button", class: "tool", "aria-label": label, title: hint, "aria-keyshortcuts": "K Space", "data-action": "play",
    });
    this.#slider = make("input", {
      type: "range", min: 0, max: tour.duration, step: "any", "aria-label": textOfPage("timeline.position"),
    });
    this.bar.append(this.#button, this.#slider, this.#time, ...signsOf(tour.loops));
    this.#listen();
    this.#refresh();
  }

  get playing(): boolean {
    return this.stage.look().led;
  }

  get seconds(): number {
    return this.tour.second(this.#passed) ?? this.duration;
  }

  get #ended(): boolean {
    return this.loops === "none" && this.#passed >= this.duration;
  }

  play(): void {
    if (this.#ended) this.#passed = 0;
    this.#leaveFloor();
    this.stage.lead((seconds) => {
      if (this.#ended) return null;
      this.#passed += seconds;
      if (this.#ended) this.#passed = this.duration; // the last picture is that of the end
      return this.tour.at(this.#passed);
    });
    this.#refresh();
  }

  pause(): void {
    this.stage.lead(null);
    this.#refresh();
  }

  seek(seconds: number): void {
    this.#passed = clamp(seconds, 0, this.duration);
    const view = this.tour.at(this.#passed);
    if (view && (!this.playing || this.#ended)) { // else it leads the view on from there
      this.#leaveFloor();
      this.stage.go(view, true);
    }
    this.#refresh();
  }

  /** Fly: tracks know no floor. */
  #leaveFloor(): void {
    if (this.stage.look().mode === "walk") this.stage.turn("fly");
  }

  #toggle(): void {
    if (this.playing) this.pause();
    else this.play();
  }

  #listen(): void {
    const slider = this.#slider;
    on(this.#button, "click", () => this.#toggle());
    on(slider, "pointerdown", () => {
      this.#grasped = this.playing;
      if (this.#grasped) this.pause();
    });
    on(slider, "input", () => this.seek(Number(slider.value)));
    for (const end of ["pointerup", "pointercancel"] as const) on(slider, end, () => this.#release());
    on(slider, "keydown", (event) => this.#press(event));
    this.stage.follow(() => this.#refresh());
    if (!this.stage.visitor) return;
    for (const stir of STIRS) document.addEventListener(stir, () => this.#appear(), true);
    this.#appear();
  }

  #release(): void {
    if (this.#grasped) this.play();
    this.#grasped = false;
  }

  #press(event: KeyboardEvent): void {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const page = PAGE_SHARE * this.duration, now = this.seconds;
    const places: Record<string, number> = {
      ArrowLeft: now - ARROW_SECONDS, ArrowDown: now - ARROW_SECONDS, ArrowRight: now + ARROW_SECONDS,
      ArrowUp: now + ARROW_SECONDS, PageDown: now - page, PageUp: now + page, Home: 0, End: this.duration,
    };
    if (event.key === " ") this.#toggle();
    else if (event.key in places) this.seek(places[event.key]);
    else return;
    event.preventDefault();
  }

  /** Show the controls to a visitor, and hide them again once no hand has moved for a while. */
  #appear(): void {
    this.bar.classList.remove("away");
    clearTimeout(this.#timer);
    this.#timer = window.setTimeout(() => {
      const used = this.bar.matches(":hover, :focus-within");
      this.bar.classList.toggle("away", this.playing && !used);
    }, IDLE_MS);
  }

  #refresh(): void {
    const { playing, seconds, duration } = this;
    if (playing !== this.#shown) {
      this.#button.replaceChildren(icon(playing ? "pause" : "play"));
      this.#button.setAttribute("aria-pressed", String(playing));
      this.#shown = playing;
      if (this.stage.visitor) this.#appear();
    }
    this.#slider.value = String(seconds);
    const value = textOfPage("timeline.value", { now: Math.floor(seconds), all: Math.round(10 * duration) / 10 });
    this.#slider.setAttribute("aria-valuetext", value);
    setText(this.#time, `${clock(seconds)} / ${clock(duration)}`);
  }
}

/** Return a sign for a track that does not end. */
function signsOf(loops: Loops): HTMLElement[] {
  if (loops === "none") return [];
  const label = textOfPage(`timeline.${loops}`);
  return [make("span", { role: "img", "aria-label": label, title: label }, icon(loops))];
}

/** Return minutes and seconds, such as 1:05. */
function clock(seconds: number): string {
  const whole = Math.floor(seconds);
  return `${Math.floor(whole / 60)}:${String(whole % 60).padStart(2, "0")}`;
}

offer("tour", (stage, settings) => new Timeline(stage, readTour(settings)));
