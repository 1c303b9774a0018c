// Gamepads of the standard layout: left stick moves, right stick looks, triggers sink and rise, buttons run actions.

import type { Held } from "./navigator.ts";

const DEAD = 0.12; // of a stick
const ACTIONS: Record<number,
  string> = { 0: "mode", 1: "home", 2: "inspect", 3: "statistics", 14: "previous", 15: "next" };

interface PadState {
  axes: readonly number[];
  buttons: readonly { pressed: boolean; value: number }[];
}

/** Return what sticks and triggers hold. */
export function readPad(pad: PadState): Held {
  const stick = (i: number): number => {
    const x = pad.axes[i] ?? 0;
    return Math.abs(x) < DEAD ? 0 : (Math.sign(x) * (Math.abs(x) - DEAD)) / (1 - DEAD);
  };
  const trigger = (i: number): number => pad.buttons[i]?.value ?? 0;
  return {
    aside: stick(0), ahead: 0 - stick(1), turn: stick(2), tilt: 0 - stick(3), above: trigger(7) - trigger(6),
    fast: Boolean(pad.buttons[4]?.pressed || pad.buttons[10]?.pressed),
  };
}

export class Gamepads {
  readonly #before = new Map<string, boolean>();

  constructor(private readonly run: (action: string) => void, wake: () => void) {
    window.addEventListener("gamepadconnected", wake);
  }

  /** Whether any gamepad must be looked at, frame by frame. */
  get connected(): boolean {
    return this.#pads().length > 0;
  }

  read(): Held | null {
    let held: Held | null = null;
    for (const pad of this.#pads()) {
      const one = readPad(pad);
      held ??= one;
      if (Object.values(one).some((value) => value !== 0 && value !== false)) held = one;
      for (const [index, action] of Object.entries(ACTIONS)) {
        const pressed = pad.buttons[Number(index)]?.pressed ?? false;
        const key = `${pad.index} ${index}`;
        if (pressed && !this.#before.get(key)) this.run(action);
        this.#before.set(key, pressed);
      }
    }
    return held;
  }

  #pads(): Gamepad[] {
    if (document.hidden || !navigator.getGamepads) return [];
    return navigator.getGamepads().filter(
      (pad): pad is Gamepad => pad !== null && pad.connected && pad.mapping === "standard",
    );
  }
}
