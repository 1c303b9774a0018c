// The help: what mouse, fingers, keys and gamepad do. Built from the table of actions.

import type { Actions } from "./actions.ts";
import { keyName } from "./controls.ts";
import { make, on } from "./dom.ts";
import { icon } from "./icons.ts";

const MOVING: [string, string][] = [
  ["Drag", "turn around, or look around"],
  ["Right button", "move sideways; also Shift and drag"],
  ["Wheel", "nearer, farther"],
  ["Double click", "go there"],
  ["W A S D, Q E", "move; with Shift faster"],
  ["Arrow keys", "orbit; or walk and turn"],
  ["+ −", "nearer, farther"],
  ["1 to 9", "saved views"],
];

const TOUCHING: [string, string][] = [
  ["One finger", "turn around, or look around"],
  ["Two fingers", "move sideways; pinch to go nearer"],
  ["Double tap", "go there"],
  ["Thumb stick", "fly or walk"],
  ["Gamepad", "left stick moves, right stick looks, triggers sink and rise"],
];

export class Help {
  readonly element = make("dialog", { class: "help", "aria-labelledby": "help-title" });

  constructor(private readonly actions: Actions) {
    on(this.element, "click", (event) => {
      if (event.target === this.element) this.element.close();
    });
  }

  open(): void {
    const close = make("button", { type: "button", class: "tool", "aria-label": "Close the help" }, icon("close"));
    on(close, "click", () => this.element.close());
    const keys = this.actions.list().filter((action) => action.key && action.available?.() !== false)
      .map((action): [string, string] => [keyName(action.key ?? ""), action.label]);
    this.element.replaceChildren(
      make("header", {}, make("h2", { id: "help-title" }, "Help"), close),
      make("div", { class: "columns", tabindex: 0, role: "group", "aria-label": "Controls" },
        table("Mouse and keys", MOVING), table("Touch and gamepad", TOUCHING), table("Shortcuts", keys)),
    );
    this.element.showModal();
  }
}

function table(title: string, rows: [string, string][]): HTMLElement {
  const list = make("dl");
  for (const [key, text] of rows) {
    list.append(
      make("div", {}, make("dt", {}, make("kbd", {}, key)), make("dd", {}, text))
    );
  }
  return make("section", {}, make("h3", {}, title), list);
}
