// The bars of the page: name and state, tools, and the dock with ways to move and views.

import type { Actions } from "./actions.ts";
import { actionButton, choices } from "./controls.ts";
import { make, setText } from "./dom.ts";
import { icon } from "./icons.ts";
import { MODES } from "./navigator.ts";
import type { Mode } from "./navigator.ts";
import { text } from "./words.ts";

const TOOLS = ["inspect", "statistics", "share", "picture", "vr", "full", "author", "options", "help"] as const;
const WIDE_ONLY = new Set(["statistics", "share", "picture", "full"]); // phones find these among the options

export class TitleBar {
  readonly element = make("header", { class: "title" });
  private readonly state = make("p", { class: "state" });
  readonly #progress = make(
    "div",
    {
      class: "progress", role: "progressbar", "aria-label": text("bar.progress"), "aria-valuemin": 0, "aria-valuemax": 100,
      hidden: true,
    },
  );

  constructor(name: string, home: string | null) {
    const back = home
      ? make("a", { class: "tool", href: home, "aria-label": text("list.back"), title: text("list.back") }, icon("back"))
      : null;
    this.element.append(...(back ? [back] : []), make("div", {}, make("h1", {}, name), this.state), this.#progress);
  }

  show(kind: string, text: string, share: number): void {
    this.element.dataset.state = kind;
    setText(this.state, text);
    const loading = kind === "connecting" || kind === "streaming";
    this.#progress.hidden = !loading;
    const percent = Math.round(100 * Math.min(Math.max(share, 0), 1));
    this.#progress.setAttribute("aria-valuenow", String(percent));
    this.#progress.style.setProperty("--share", `${percent}%`);
  }
}

export function toolBar(actions: Actions): HTMLElement {
  const bar = make("div", { class: "tools", role: "group", "aria-label": text("bar.tools") });
  for (const id of TOOLS) {
    const button = actionButton(actions, id);
    if (WIDE_ONLY.has(id)) button.classList.add("wide");
    bar.append(button);
  }
  return bar;
}

interface DockTargets {
  mode(): Mode;
  setMode(mode: Mode): void;
  views(): { count: number; label: string };
}

export class Dock {
  readonly element = make("div", { class: "dock", role: "group", "aria-label": text("bar.moving") });
  readonly #modes: { element: HTMLElement; refresh(): void };
  readonly #label = make("output", { class: "view-name" });
  private readonly views = make("div", { class: "views", role: "group", "aria-label": text("bar.views") });

  constructor(actions: Actions, private readonly targets: DockTargets) {
    this.#modes = choices<Mode>(
      "mode", text("mode.title"), MODES.map((value) => ({ value, label: text(`mode.${value}`), icon: value })),
      targets.mode, targets.setMode,
    );
    this.views.append(actionButton(actions, "previous"), this.#label, actionButton(actions, "next"));
    this.element.append(this.#modes.element, actionButton(actions, "home"), this.views);
  }

  refresh(): void {
    this.#modes.refresh();
    const { count, label } = this.targets.views();
    this.views.hidden = count < 2;
    setText(this.#label, label);
  }
}
