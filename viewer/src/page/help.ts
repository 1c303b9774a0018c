// The help: what mouse, fingers, keys and gamepad do. Built from the table of actions.

import type { Actions } from "./actions.ts";
import { keyName } from "./controls.ts";
import { make, on } from "./dom.ts";
import { icon } from "./icons.ts";
import { text } from "./words.ts";

// names of texts: what is done, and what it does
const MOVING = ["drag", "right", "wheel", "double", "letters", "arrows", "plus", "digits"] as const;
const TOUCHING = ["finger", "fingers", "tap", "stick", "pad"] as const;

export class Help {
  readonly element = make("dialog", { class: "help", "aria-labelledby": "help-title" });

  constructor(private readonly actions: Actions) {
    on(this.element, "click", (event) => {
      if (event.target === this.element) this.element.close();
    });
  }

  open(): void {
    const close = make("button", { type: "button", class: "tool", "aria-label": text("help.close") }, icon("close"));
    on(close, "click", () => this.element.close());
    const keys = this.actions.list().filter((action) => action.key && action.available?.() !== false)
      .map((action): [string, string] => [keyName(action.key ?? ""), action.label]);
    this.element.replaceChildren(
      make("header", {}, make("h2", { id: "help-title" }, text("action.help")), close),
      make("div", { class: "columns", tabindex: 0, role: "group", "aria-label": text("help.controls") },
        table(text("help.mouse"), MOVING.map(rowOf)), table(text("help.touch"), TOUCHING.map(rowOf)),
        table(text("help.keys"), keys)),
    );
    this.element.showModal();
  }
}

function rowOf(name: (typeof MOVING | typeof TOUCHING)[number]): [string, string] {
  return [text(`help.${name}`), text(`help.${name}.does`)];
}

function table(title: string, rows: [string, string][]): HTMLElement {
  const list = make("dl");
  for (const [key, does] of rows) {
    list.append(
      make("div", {}, make("dt", {}, make("kbd", {}, key)), make("dd", {}, does))
    );
  }
  return make("section", {}, make("h3", {}, title), list);
}
