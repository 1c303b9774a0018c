// The place at the side (on phones at the bottom) that shows one panel at a time.

import { make, on } from "./dom.ts";
import { icon } from "./icons.ts";
import { text } from "./words.ts";

export class Side {
  readonly element = make("section", { class: "side", hidden: true, "aria-labelledby": "side-title" });
  readonly #title = make("h2", { id: "side-title" });
  readonly #body = make(
    "div", { class: "side-body", tabindex: 0, role: "group", "aria-labelledby": "side-title" },
  );
  #name = "";
  #opener: Element | null = null;

  constructor(private readonly changed: () => void) {
    const close = make(
      "button", { type: "button", class: "tool", "aria-label": text("side.close"), title: text("side.close.hint") }, icon("close"),
    );
    on(close, "click", () => this.close());
    this.element.append(make("header", {}, this.#title, close), this.#body);
  }

  shows(name: string): boolean {
    return !this.element.hidden && this.#name === name;
  }

  open(name: string, title: string, ...content: Node[]): void {
    if (this.element.hidden) this.#opener = document.activeElement;
    this.#name = name;
    this.#title.textContent = title;
    this.#body.replaceChildren(...content);
    this.#body.scrollTop = 0;
    this.element.hidden = false;
    document.documentElement.dataset.side = name;
    this.changed();
  }

  /** Close, and give the focus back if it was inside; return whether anything was open. */
  close(): boolean {
    if (this.element.hidden) return false;
    const inside = this.element.contains(document.activeElement);
    this.element.hidden = true;
    delete document.documentElement.dataset.side;
    if (inside && this.#opener instanceof HTMLElement) this.#opener.focus();
    this.changed();
    return true;
  }
}
