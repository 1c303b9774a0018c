// Turns what hands do into motion: keys, pointers, stick and gamepads move the navigator, frame by frame while needed.

import type { Actions } from "./actions.ts";
import { Gamepads } from "./gamepad.ts";
import { Joystick } from "./joystick.ts";
import { Keyboard } from "./keyboard.ts";
import { Navigator } from "./navigator.ts";
import type { Held } from "./navigator.ts";
import { Pointers } from "./pointer.ts";
import { NORMAL_FOV, rigFromTarget } from "./rig.ts";
import { frameFromUp } from "./vector.ts";

const REST_MS = 300; // without motion, after which a view is at rest
const LONGEST_FRAME = 0.25; // seconds of motion in one frame

interface DriveTargets {
  actions: Actions;
  moved(): void;
  rested(): void;
  click(x: number, y: number, withAlt: boolean): void;
  doubleClick(x: number, y: number): void;
  view(index: number): void;
  escape(): boolean;
}

export class Drive {
  readonly navigator: Navigator;
  readonly joystick = new Joystick(() => this.wake());
  readonly #gamepads: Gamepads;
  #keyboard: Keyboard | null = null;
  #running = false;
  #last = 0;
  #timer = 0;

  constructor(private readonly targets: DriveTargets) {
    const frame = frameFromUp([0, 0, 1]);
    this.navigator = new Navigator(frame, rigFromTarget([0, 0, 0], frame.north, frame, NORMAL_FOV));
    this.#gamepads = new Gamepads((action) => targets.actions.run(action), () => this.wake());
    const reduced = matchMedia("(prefers-reduced-motion: reduce)");
    const calm = (): void => void (this.navigator.calm = reduced.matches);
    reduced.addEventListener("change", calm);
    calm();
  }

  /** Listen to this canvas, and no longer to the one before. */
  listen(canvas: HTMLCanvasElement): void {
    const { navigator, targets } = this;
    const wake = (): void => this.wake();
    new Pointers(
      canvas,
      { navigator, wake, click: (x, y, event) => targets.click(x, y, event.altKey), doubleClick: targets.doubleClick },
    );
    this.#keyboard?.stop();
    this.#keyboard = new Keyboard(canvas, {
      actions: targets.actions, mode: () => navigator.mode, wake, view: targets.view, escape: targets.escape,
      zoom: (factor) => (navigator.zoom(factor), this.wake()),
      pickCenter: () => targets.click(canvas.clientWidth / 2, canvas.clientHeight / 2, true),
    });
  }

  /** Move until nothing is held and the view is at rest. */
  wake(): void {
    if (this.#running) return;
    this.#running = true;
    this.#last = performance.now();
    requestAnimationFrame((now) => this.#tick(now));
  }

  #tick(now: number): void {
    const seconds = Math.min(Math.max((now - this.#last) / 1000, 0), LONGEST_FRAME);
    this.#last = now;
    const moved = this.navigator.step(seconds, this.held());
    if (moved) this.#report();
    if (moved || this.#keyboard?.busy || this.joystick.busy || this.#gamepads.connected || this.navigator.flying) {
      requestAnimationFrame((next) => this.#tick(next));
    } else {
      this.#running = false;
    }
  }

  #report(): void {
    this.targets.moved();
    clearTimeout(this.#timer);
    this.#timer = window.setTimeout(() => this.targets.rested(), REST_MS);
  }

  private held(): Held {
    const held = this.#keyboard?.held() ?? { ahead: 0, aside: 0, above: 0, turn: 0, tilt: 0, fast: false };
    const pad = this.#gamepads.read();
    held.ahead += this.joystick.ahead;
    held.aside += this.joystick.aside;
    if (!pad) return held;
    for (const axis of ["ahead", "aside", "above", "turn", "tilt"] as const) held[axis] += pad[axis];
    return { ...held, fast: held.fast || pad.fast };
  }
}
