// Moves the camera: takes turns, steps and flights, and gives a smooth view for each moment. Three ways to move:
// orbit around what is looked at, fly freely, walk at the height of an eye. Knows no browser; time is an argument.

import { LevelGround } from "./ground.ts";
import type { Ground } from "./ground.ts";
import { alike, approach, aroundBetween, between, look, orbit, pivot, rigFromTarget, slide, walk } from "./rig.ts";
import { LEAST_FOV, MOST_FOV } from "./rig.ts";
import type { Rig } from "./rig.ts";
import { add, clamp, distance, mix, scale } from "./vector.ts";
import type { Frame, Vec3 } from "./vector.ts";

export type Mode = "orbit" | "fly" | "walk";
export const MODES: readonly Mode[] = ["orbit", "fly", "walk"];

/** What keys, sticks and joysticks hold at the moment: each from -1 to 1. */
export interface Held {
  ahead: number;
  aside: number;
  above: number;
  turn: number;
  tilt: number;
  fast: boolean;
}

export const NOTHING_HELD: Held = { ahead: 0, aside: 0, above: 0, turn: 0, tilt: 0, fast: false };

const SETTLE = 0.07; // seconds in which a view comes 63% nearer to where it is wanted
const TURN_SPEED = 1.6; // radians a second
const FLIGHT = 0.9; // seconds from view to view
const METERS_A_SECOND = { orbit: 2.0, fly: 2.5, walk: 1.6 };
const FAST = 3;

export class Navigator {
  frame: Frame;
  mode: Mode = "orbit";
  pace = 1; // chosen by the visitor
  meter: number; // scene units in a meter, known or guessed
  calm = false; // jump instead of flying
  shown: Rig;
  #wanted: Rig;
  track: ((seconds: number) => Rig | null) | null = null; // leads the view, by seconds since the last one, until it ends
  #flight: { from: Rig; to: Rig; spent: number } | null = null;
  #ground: Ground;

  constructor(frame: Frame, rig: Rig, meter = 1) {
    this.frame = frame;
    this.meter = meter;
    this.shown = rig;
    this.#wanted = rig;
    this.#ground = new LevelGround(frame);
  }

  get flying(): boolean {
    return this.#flight !== null || this.track !== null;
  }

  /** Stand there at once. */
  place(rig: Rig): void {
    this.#flight = this.track = null;
    this.#wanted = this.mode === "walk" ? this.#standing(rig) : rig;
    this.shown = this.#wanted;
  }

  /** Fly to a view, or jump where motion is unwanted. */
  flyTo(rig: Rig): void {
    const to = this.mode === "walk" ? this.#standing(rig) : rig;
    if (this.calm) return this.place(to);
    this.track = null;
    this.#flight = { from: this.shown, to, spent: 0 };
    this.#wanted = to;
  }

  /** Take another frame: the eye and what it looks at stay. */
  reframe(frame: Frame): void {
    const again = (rig: Rig): Rig => rigFromTarget(rig.eye, pivot(rig, this.frame), frame, rig.fovY);
    this.shown = again(this.shown);
    this.#wanted = again(this.#wanted);
    this.frame = frame;
    this.#flight = null;
    this.#ground = new LevelGround(frame);
  }

  /** Walk on this ground from now on. */
  standOn(ground: Ground): void {
    this.#ground = ground;
    if (this.mode === "walk") this.flyTo(this.#wanted);
  }

  /** Say how far away lies what is looked at; the view stays. */
  refocus(reach: number): void {
    if (!(reach > 0) || !Number.isFinite(reach)) return;
    this.#wanted = { ...this.#wanted, reach };
    if (this.#flight) this.#flight.to = { ...this.#flight.to, reach };
    else this.shown = { ...this.shown, reach };
  }

  /** Whether a walker can stand there, give or take half a meter. */
  canStandAt(eye: Vec3): boolean {
    return distance(this.#ground.nearest(eye), eye) < 0.5 * this.meter;
  }

  setMode(mode: Mode): void {
    if (mode === this.mode) return;
    this.mode = mode;
    if (mode === "walk") this.flyTo(this.#wanted);
  }

  /** Drag by radians: around the pivot, or on the spot. Dragging takes hold of the scene, as maps do. */
  drag(turn: number, tilt: number): void {
    this.#take();
    this.#wanted = this.mode === "orbit" ? orbit(this.#wanted, this.frame, turn, tilt) : look(this.#wanted, turn, tilt);
  }

  /** Drag sideways by shares of the image's height. */
  pan(aside: number, above: number): void {
    this.#take();
    const size = 2 * Math.tan(this.#wanted.fovY / 2) * (this.mode === "orbit" ? this.#wanted.reach : 3 * this.meter);
    const moved = this.mode === "walk" ? walk(this.#wanted, this.frame, aside * size, 0, above * size)
      : slide(this.#wanted, this.frame, aside * size, above * size, 0);
    this.#go(moved);
  }

  /** Wheel or pinch: nearer by a factor below 1. */
  zoom(factor: number): void {
    this.#take();
    if (this.mode === "orbit") {
      this.#wanted = approach(this.#wanted, this.frame, factor, 0.02 * this.meter, 1e4 * this.meter);
    } else {
      const steps = -Math.log(factor) * 2 * this.meter * this.pace;
      this.#go((this.mode === "walk" ? walk : slide)(this.#wanted, this.frame, 0, 0, steps));
    }
  }

  setFov(fovY: number): void {
    this.#wanted = { ...this.#wanted, fovY: clamp(fovY, LEAST_FOV, MOST_FOV) };
  }

  /** Look at a point (orbit), walk to it, or fly until shortly before it. */
  goTo(point: Vec3): void {
    const rig = this.#wanted;
    const away = distance(point, rig.eye);
    if (this.mode === "orbit") {
      const seen = rigFromTarget(rig.eye, point, this.frame, rig.fovY);
      this.flyTo(approach(seen, this.frame, 0.7, 0.02 * this.meter));
    } else {
      const share = Math.max(0, 1 - (this.mode === "walk" ? 0.6 : 1) * this.meter / Math.max(away, 1e-9));
      const eye = mix(rig.eye, point, share);
      this.flyTo({ ...rig, eye: this.mode === "walk" ? this.#ground.step(rig.eye, eye) : eye });
    }
  }

  /** Advance by seconds; return whether the view has changed. */
  step(seconds: number, held: Held = NOTHING_HELD): boolean {
    const before = this.shown;
    const still = held.ahead === 0 && held.aside === 0 && held.above === 0 && held.turn === 0 && held.tilt === 0;
    if (!still) this.#hold(seconds, held);
    const led = this.track?.(seconds);
    if (led) this.shown = this.#wanted = led;
    else {
      this.track = null;
      if (this.#flight) this.#fly(this.#flight, seconds);
      else this.#settle(seconds);
    }
    return this.shown !== before;
  }

  #take(): void {
    if (this.#flight) this.#wanted = this.shown;
    this.#flight = this.track = null;
  }

  #hold(seconds: number, held: Held): void {
    this.#take();
    const turn = TURN_SPEED * seconds;
    if (this.mode === "orbit") this.#wanted = orbit(this.#wanted, this.frame, -held.turn * turn, -held.tilt * turn);
    else this.#wanted = look(this.#wanted, held.turn * turn, held.tilt * turn);
    const fit = this.mode === "orbit"
      ? Math.max(0.3 * this.#wanted.reach, 0.2 * this.meter)
      : METERS_A_SECOND[this.mode] * this.meter;
    const way = fit * this.pace * seconds * (held.fast ? FAST : 1);
    if (held.ahead === 0 && held.aside === 0 && held.above === 0) return;
    const size = Math.max(1, Math.hypot(held.ahead, held.aside));
    const [aside, above, ahead] = [(held.aside * way) / size, held.above * way, (held.ahead * way) / size];
    if (this.mode === "fly") {
      const moved = slide(this.#wanted, this.frame, aside, 0, ahead);
      this.#go({ ...moved, eye: add(moved.eye, scale(this.frame.up, above)) });
    } else {
      this.#go(walk(this.#wanted, this.frame, aside, this.mode === "walk" ? 0 : above, ahead));
    }
  }

  #go(moved: Rig): void {
    this.#wanted = this.mode === "walk" ? { ...moved, eye: this.#ground.step(this.#wanted.eye, moved.eye) } : moved;
  }

  #standing(rig: Rig): Rig {
    return { ...rig, eye: this.#ground.nearest(rig.eye) };
  }

  #fly(flight: { from: Rig; to: Rig; spent: number }, seconds: number): void {
    flight.spent += seconds;
    const t = clamp(flight.spent / FLIGHT, 0, 1);
    const eased = t < 0.5 ? 4 * t * t * t : 1 - 4 * (1 - t) ** 3;
    this.shown = t >= 1 ? flight.to : this.#blend(flight.from, flight.to, eased);
    if (t >= 1) this.#flight = null;
  }

  #settle(seconds: number): void {
    if (this.shown === this.#wanted) return;
    const share = 1 - Math.exp(-seconds / SETTLE);
    const next = this.#blend(this.shown, this.#wanted, share);
    this.shown = alike(next, this.#wanted) ? this.#wanted : next;
  }

  #blend(a: Rig, b: Rig, t: number): Rig {
    return this.mode === "orbit" ? aroundBetween(a, b, t, this.frame) : between(a, b, t);
  }
}
