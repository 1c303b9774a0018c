// Mouse, pen and fingers on the canvas: drags turn, two fingers or the right button pan, wheel and pinch zoom, clicks
// pick.

import type { Navigator } from "./navigator.ts";

const STILL = 6; // pixels that a click may move
const CLICK = 400; // milliseconds that it may last
const DOUBLE = 320; // between two clicks

interface PointerTargets {
  navigator: Navigator;
  wake(): void;
  click(x: number, y: number, event: PointerEvent): void;
  doubleClick(x: number, y: number): void;
}

interface Finger {
  x: number;
  y: number;
}

export class Pointers {
  readonly #fingers = new Map<number, Finger>();
  #start: (Finger & { time: number }) | null = null;
  #last: (Finger & { time: number }) | null = null;

  constructor(private readonly canvas: HTMLCanvasElement, private readonly targets: PointerTargets) {
    canvas.addEventListener("pointerdown", (event) => this.#press(event));
    canvas.addEventListener("pointermove", (event) => this.#move(event));
    canvas.addEventListener("pointerup", (event) => this.#lift(event));
    canvas.addEventListener("pointercancel", (event) => this.#drop(event));
    canvas.addEventListener("wheel", (event) => this.#wheel(event), { passive: false });
    canvas.addEventListener("blur", () => delete canvas.dataset.pointed);
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  }

  #press(event: PointerEvent): void {
    this.canvas.setPointerCapture(event.pointerId);
    this.canvas.dataset.pointed = ""; // no ring: browsers draw one around what a script gives the focus
    this.canvas.focus({ preventScroll: true });
    this.#fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    this.#start = this.#fingers.size === 1 ? { x: event.clientX, y: event.clientY, time: event.timeStamp } : null;
    this.canvas.dataset.held = "";
    event.preventDefault();
  }

  #move(event: PointerEvent): void {
    const finger = this.#fingers.get(event.pointerId);
    if (!finger) return;
    const [dx, dy] = [event.clientX - finger.x, event.clientY - finger.y];
    if (dx === 0 && dy === 0) return;
    const before = this.#spread();
    this.#fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    const start = this.#start;
    if (start && Math.hypot(event.clientX - start.x, event.clientY - start.y) > STILL) this.#start = null;
    const height = Math.max(this.canvas.clientHeight, 1);
    const { navigator } = this.targets;
    if (this.#fingers.size > 1) {
      const after = this.#spread();
      navigator.pan(-dx / this.#fingers.size / height, dy / this.#fingers.size / height);
      if (before > 0 && after > 0) navigator.zoom(before / after);
    } else if (event.buttons & 6 || (event.shiftKey && event.pointerType === "mouse")) {
      navigator.pan(-dx / height, dy / height);
    } else if (navigator.mode === "orbit") {
      navigator.drag((dx / height) * Math.PI, (-dy / height) * Math.PI);
    } else {
      const angle = Math.max(navigator.shown.fovY, 0.5) * 1.2;
      navigator.drag((-dx / height) * angle, (dy / height) * angle);
    }
    this.targets.wake();
  }

  #lift(event: PointerEvent): void {
    const start = this.#start;
    this.#drop(event);
    if (!start || event.timeStamp - start.time > CLICK || event.button !== 0) return;
    const box = this.canvas.getBoundingClientRect();
    const [x, y] = [event.clientX - box.left, event.clientY - box.top];
    const again = this.#last && event.timeStamp - this.#last.time < DOUBLE &&
      Math.hypot(x - this.#last.x, y - this.#last.y) < 4 * STILL;
    this.#last = again ? null : { x, y, time: event.timeStamp };
    if (again) this.targets.doubleClick(x, y);
    else this.targets.click(x, y, event);
  }

  #drop(event: PointerEvent): void {
    this.#fingers.delete(event.pointerId);
    this.#start = null;
    if (this.#fingers.size === 0) delete this.canvas.dataset.held;
  }

  #wheel(event: WheelEvent): void {
    event.preventDefault();
    const unit = event.deltaMode === 1 ? 30 : event.deltaMode === 2 ? 400 : 1;
    const pixels = Math.max(-400, Math.min(400, event.deltaY * unit));
    this.targets.navigator.zoom(Math.exp(pixels * (event.ctrlKey ? 0.01 : 0.0012)));
    this.targets.wake();
  }

  /** Return the mean distance of two fingers from their middle, 0 for any other number. */
  #spread(): number {
    if (this.#fingers.size !== 2) return 0;
    const [a, b] = [...this.#fingers.values()];
    return Math.hypot(a.x - b.x, a.y - b.y);
  }
}
