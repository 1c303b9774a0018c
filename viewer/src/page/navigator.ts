// Moves the camera: takes turns, steps and flights, and gives a smooth view for each moment. Three ways to move:
// orbit around what is looked at, fly freely, walk at the height of an eye. Knows no browser; time is an argument.

import { LevelGround } from "./ground.ts";
import type { Ground } from "./ground.ts";
import { alike, approach, aroundBetween, between, look, orbit, pivot, rigFromTarget, slide, walk } from "./rig.ts";
import { LEAST_FOV, MOST_FOV } from "./rig.ts";
import type { Rig } from "./rig.ts";
import { add, clamp, distance, dot, length, mix, scale, subtract } from "./vector.ts";
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
const EYE_M = 1.6; // height of a walker's eye that walks at that speed
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
  #speed: Vec3 = [0, 0, 0]; // of a walker, scene units a second

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
    this.#rest();
    this.#wanted = this.mode === "walk" ? this.#standing(rig) : rig;
    this.shown = this.#wanted;
  }

  /** Fly to a view, or jump where motion is unwanted. */
  flyTo(rig: Rig): void {
    const to = this.mode === "walk" ? this.#standing(rig) : rig;
    if (this.calm) return this.place(to);
    this.#rest();
    this.#flight = { from: this.shown, to, spent: 0 };
    this.#wanted = to;
  }

  /** Take another frame: the eye and what it looks at stay. */
  reframe(frame: Frame): void {
    const again = (rig: Rig): Rig => rigFromTarget(rig.eye, pivot(rig, this.frame), frame, rig.fovY);
    this.shown = again(this.shown);
    this.#wanted = again(this.#wanted);
    this.frame = frame;
    this.#rest();
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

  /** Whether a walker can stand there, give or take half a meter or the half of its height. */
  canStandAt(eye: Vec3): boolean {
    return distance(this.#ground.nearest(eye), eye) < 0.5 * (this.#ground.eye ?? this.meter);
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
      const ground = this.#ground;
      const reached = (ground.straight ?? ground.step).call(ground, rig.eye, eye);
      this.flyTo({ ...rig, eye: this.mode === "walk" ? reached : eye });
    }
  }

  /** Advance by seconds; return whether the view has changed. */
  step(seconds: number, held: Held = NOTHING_HELD): boolean {
    const before = this.shown;
    let wish: Vec3 = [0, 0, 0];
    const still = held.ahead === 0 && held.aside === 0 && held.above === 0 && held.turn === 0 && held.tilt === 0;
    if (!still) wish = this.#hold(seconds, held);
    const led = this.track?.(seconds);
    if (led) this.shown = this.#wanted = led;
    else {
      this.track = null;
      if (this.#flight) this.#fly(this.#flight, seconds);
      else {
        if (this.mode === "walk") this.#walk(seconds, wish);
        this.#settle(seconds);
      }
    }
    return this.shown !== before || length(this.#speed) > 0; // the first frame may take no time
  }

  #rest(): void {
    this.#flight = this.track = null;
    this.#speed = [0, 0, 0];
  }

  #take(): void {
    if (this.#flight) this.#wanted = this.shown;
    this.#flight = this.track = null;
  }

  /** Turn and move as the keys say; return the speed that a walker wants. */
  #hold(seconds: number, held: Held): Vec3 {
    this.#take();
    const { mode, frame } = this, turn = TURN_SPEED * seconds;
    if (mode === "orbit") this.#wanted = orbit(this.#wanted, frame, -held.turn * turn, -held.tilt * turn);
    else this.#wanted = look(this.#wanted, held.turn * turn, held.tilt * turn);
    const meter = mode === "walk" && this.#ground.eye ? this.#ground.eye / EYE_M : this.meter;
    const fit = mode === "orbit" ? Math.max(0.3 * this.#wanted.reach, 0.2 * meter) : METERS_A_SECOND[mode] * meter;
    const speed = fit * this.pace * (held.fast ? FAST : 1), size = Math.max(1, Math.hypot(held.ahead, held.aside));
    const [aside, ahead] = [(held.aside * speed) / size, (held.ahead * speed) / size], above = held.above * speed;
    const rig = this.#wanted;
    if (mode === "walk") return subtract(walk(rig, frame, aside, 0, ahead).eye, rig.eye);
    if (mode === "orbit") this.#wanted = walk(rig, frame, aside * seconds, above * seconds, ahead * seconds);
    else {
      const moved = slide(rig, frame, aside * seconds, 0, ahead * seconds);
      this.#wanted = { ...moved, eye: add(moved.eye, scale(frame.up, above * seconds)) };
    }
    return [0, 0, 0];
  }

  /** Move there; a walker gets the speed that brings it there. */
  #go(moved: Rig): void {
    if (this.mode !== "walk") this.#wanted = moved;
    else this.#speed = add(this.#speed, scale(subtract(moved.eye, this.#wanted.eye), 1 / SETTLE));
  }

  /** Let a walker come nearer to the wanted speed, go on, and fall; what it shows never lags behind it, but upwards. */
  #walk(seconds: number, wish: Vec3): void {
    const { eye } = this.#wanted, share = 1 - Math.exp(-seconds / SETTLE);
    let change = subtract(this.#speed, wish), way = add(scale(wish, seconds), scale(change, SETTLE * share));
    change = scale(change, 1 - share);
    if (length(wish) === 0 && length(change) * SETTLE < 1e-5 * this.#wanted.reach) {
      way = add(way, scale(change, SETTLE)); // the rest of it
      change = [0, 0, 0];
    }
    this.#speed = add(wish, change);
    let next = length(way) > 0 ? this.#ground.step(eye, add(eye, way)) : eye;
    next = this.#ground.fall?.(next, seconds) ?? next;
    if (next === eye) return;
    this.#wanted = { ...this.#wanted, eye: next };
    const lag = Math.min(0, dot(subtract(this.shown.eye, next), this.frame.up));
    this.shown = { ...this.shown, eye: add(next, scale(this.frame.up, lag)) };
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
