// Keys: held ones move (by their place on the keyboard), others run actions.

import type { Actions } from "./actions.ts";
import type { Held, Mode } from "./navigator.ts";

const MOVES: Record<string, Partial<Held>> = {
  KeyW: { ahead: 1 }, KeyS: { ahead: -1 }, KeyA: { aside: -1 }, KeyD: { aside: 1 }, KeyE: { above: 1 },
  KeyQ: { above: -1 },
  ArrowLeft: { turn: -1 }, ArrowRight: { turn: 1 }, PageUp: { tilt: 1 }, PageDown: { tilt: -1 },
};
const ARROWS = {
  orbit: { ArrowUp: { tilt: 1 }, ArrowDown: { tilt: -1 } }, other: { ArrowUp: { ahead: 1 }, ArrowDown: { ahead: -1 } },
};

interface KeyTargets {
  actions: Actions;
  mode(): Mode;
  wake(): void;
  view(index: number): void;
  zoom(factor: number): void;
  pickCenter(): void;
  escape(): boolean;
}

export class Keyboard {
  readonly #down = new Set<string>();
  readonly #tapped = new Set<string>(); // pressed since the last look: counts even if it is up again
  #fast = false;
  readonly #life = new AbortController();

  constructor(private readonly canvas: HTMLElement, private readonly targets: KeyTargets) {
    const { signal } = this.#life;
    window.addEventListener("keydown", (event) => this.#press(event), { signal });
    window.addEventListener("keyup", (event) => this.#release(event), { signal });
    window.addEventListener("blur", () => this.clear(), { signal });
    document.addEventListener("visibilitychange", () => this.clear(), { signal });
  }

  stop(): void {
    this.#life.abort();
  }

  get busy(): boolean {
    return this.#down.size + this.#tapped.size > 0;
  }

  /** Sum of all held keys. */
  held(): Held {
    const sum: Held = { ahead: 0, aside: 0, above: 0, turn: 0, tilt: 0, fast: this.#fast };
    const arrows = this.targets.mode() === "orbit" ? ARROWS.orbit : ARROWS.other;
    for (const code of new Set([...this.#down, ...this.#tapped])) {
      const moves: Partial<Held> = (arrows as Record<string, Partial<Held>>)[code] ?? MOVES[code] ?? {};
      for (const axis of ["ahead", "aside", "above", "turn", "tilt"] as const) sum[axis] += moves[axis] ?? 0;
    }
    this.#tapped.clear();
    return sum;
  }

  clear(): void {
    this.#down.clear();
    this.#tapped.clear();
    this.#fast = false;
  }

  #press(event: KeyboardEvent): void {
    this.#fast = event.shiftKey;
    if (event.ctrlKey || event.metaKey || event.altKey || event.defaultPrevented) return;
    const target = event.target instanceof Element ? event.target : null;
    if (target?.closest("dialog")) return;
    if (event.key === "Escape" && this.targets.escape()) return event.preventDefault();
    if (target?.matches("textarea, select, input:not([type=checkbox], [type=radio], [type=range])")) return;
    const onScene = target === this.canvas || target === document.body;
    const letter = event.code.startsWith("Key") && event.code in MOVES;
    if (letter || (onScene && (event.code in MOVES || event.code in ARROWS.orbit))) {
      this.#down.add(event.code);
      this.#tapped.add(event.code);
      this.targets.wake();
      return event.preventDefault();
    }
    if (!event.repeat && this.#once(event, onScene)) event.preventDefault();
  }

  #once(event: KeyboardEvent, onScene: boolean): boolean {
    const { targets } = this;
    if (/^[1-9]$/.test(event.key)) targets.view(Number(event.key) - 1);
    else if (onScene && (event.key === "+" || event.key === "=")) targets.zoom(1 / 1.25);
    else if (onScene && event.key === "-") targets.zoom(1.25);
    else if (onScene && event.key === "Enter") targets.pickCenter();
    else if (onScene && event.key === " ") targets.actions.run("play");
    else {
      const action = targets.actions.find(event.key);
      if (!action) return false;
      targets.actions.run(action.id);
    }
    return true;
  }

  #release(event: KeyboardEvent): void {
    this.#fast = event.shiftKey;
    this.#down.delete(event.code);
  }
}
