// Everything that the visitor can do by name: one table for buttons, keys and the help.

import type { IconName } from "./icons.ts";

interface Action {
  id: string;
  label: string;
  key?: string; // as KeyboardEvent.key gives it, in lower case
  icon?: IconName;
  run(): void;
  pressed?(): boolean;
  available?(): boolean;
}

export class Actions {
  readonly #all = new Map<string, Action>();
  readonly #watchers: (() => void)[] = [];

  add(action: Action): void {
    this.#all.set(action.id, action);
  }

  get(id: string): Action {
    const action = this.#all.get(id);
    if (!action) throw new Error(`no action is named ${id}`);
    return action;
  }

  list(): Action[] {
    return [...this.#all.values()];
  }

  /** Run an action if it is available; then everything that shows its state looks again. */
  run(id: string): void {
    const action = this.get(id);
    if (action.available?.() === false) return;
    action.run();
    this.changed();
  }

  /** Find the action of a key that was pressed without Ctrl, Alt or Meta. */
  find(key: string): Action | null {
    return this.list().find((action) => action.key === key.toLowerCase()) ?? null;
  }

  watch(look: () => void): void {
    this.#watchers.push(look);
    look();
  }

  changed(): void {
    for (const look of this.#watchers) look();
  }
}
