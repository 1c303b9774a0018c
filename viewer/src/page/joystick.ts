// A stick for the thumb, on touch screens that fly or walk.

import { make } from "./dom.ts";
import { clamp } from "./vector.ts";

export class Joystick {
  readonly element = make("div", { class: "joystick", "aria-hidden": "true" });
  aside = 0;
  ahead = 0;
  readonly #knob = make("div", { class: "knob" });
  #finger: number | null = null;

  constructor(wake: () => void) {
    this.element.append(this.#knob);
    this.element.addEventListener("pointerdown", (event) => {
      this.#finger = event.pointerId;
      this.element.setPointerCapture(event.pointerId);
      this.#follow(event);
      wake();
      event.preventDefault();
    });
    this.element.addEventListener("pointermove", (event) => {
      if (event.pointerId === this.#finger) this.#follow(event);
    });
    for (const type of ["pointerup", "pointercancel"] as const) {
      this.element.addEventListener(type, (event) => {
        if (event.pointerId === this.#finger) this.#release();
      });
    }
  }

  get busy(): boolean {
    return this.#finger !== null;
  }

  #follow(event: PointerEvent): void {
    const box = this.element.getBoundingClientRect();
    const radius = box.width / 2;
    const [x, y] = [(event.clientX - box.left) / radius - 1, (event.clientY - box.top) / radius - 1];
    const size = Math.max(1, Math.hypot(x, y));
    this.#set(clamp(x / size, -1, 1), clamp(-y / size, -1, 1));
  }

  #release(): void {
    this.#finger = null;
    this.#set(0, 0);
  }

  #set(aside: number, ahead: number): void {
    [this.aside, this.ahead] = [aside, ahead];
    this.#knob.style.setProperty("--x", `${aside * 28}px`);
    this.#knob.style.setProperty("--y", `${-ahead * 28}px`);
  }
}
