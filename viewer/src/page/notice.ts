// Messages on the page: a card in the middle that stops, a line at the bottom that passes.

import { make, on, setText } from "./dom.ts";
import type { Message } from "./messages.ts";
import { text } from "./words.ts";

const PASSES = 6000; // milliseconds

interface NoticeTargets {
  retry(): void;
  token(token: string): void;
}

export class Notices {
  readonly card = make("section", { class: "card", role: "alert", hidden: true });
  readonly line = make("p", { class: "toast", role: "status", "aria-live": "polite" });
  #timer = 0;

  constructor(private readonly targets: NoticeTargets) {}

  /** Show a card until `clear`. */
  stop(message: Message): void {
    const parts: Node[] = [make("h2", {}, message.title), make("p", {}, message.text)];
    if (message.token) parts.push(this.#tokenForm());
    if (message.detail) {
      parts.push(
        make(
          "details", { open: message.token === true }, make("summary", {}, text("notice.said")),
          make("code", {}, message.detail),
        )
      );
    }
    if (message.retry) {
      const retry = make("button", { type: "button", class: "primary" }, text("notice.retry"));
      on(retry, "click", () => this.targets.retry());
      parts.push(retry);
    }
    this.card.replaceChildren(...parts);
    this.card.hidden = false;
    this.card.querySelector<HTMLElement>("input:not([hidden]), button")?.focus();
  }

  clear(): void {
    this.card.hidden = true;
  }

  /** Say something for some seconds, or until another line comes. */
  say(line: string, lasting = false): void {
    clearTimeout(this.#timer);
    setText(this.line, line);
    if (line && !lasting) this.#timer = window.setTimeout(() => setText(this.line, ""), PASSES);
  }

  #tokenForm(): HTMLFormElement {
    const input = make(
      "input", { type: "password", id: "token", name: "token", required: true, autocomplete: "current-password" },
    );
    // for password managers
    const user = make(
      "input", { type: "text", name: "username", autocomplete: "username", value: "gsvis", hidden: true },
    );
    const form = make(
      "form", { class: "token" }, user, make("label", { for: "token" }, text("notice.token")), input,
      make("button", { class: "primary" }, text("notice.open")),
    );
    on(form, "submit", (event) => {
      event.preventDefault();
      if (input.value.trim()) this.targets.token(input.value.trim());
    });
    return form;
  }
}
