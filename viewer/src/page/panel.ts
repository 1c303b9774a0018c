// The options: what the colors show, levels, terms, cells, field of view, pace, theme, and the actions of small
// screens.

import type { Header, Marks, Paint } from "../core/types.ts";
import type { Actions } from "./actions.ts";
import { actionButton, choices, slider, toggle } from "./controls.ts";
import { make } from "./dom.ts";
import { formatCount } from "./format.ts";
import { LEGENDS, levelColor, PAINTS } from "./paints.ts";
import { NOT_SERVED } from "./messages.ts";
import type { Theme } from "./theme.ts";
import type { ViewerLike } from "./viewer-like.ts";

interface PanelTargets {
  viewer: () => ViewerLike | null;
  actions: Actions;
  theme: { chosen: Theme; choose(theme: Theme): void };
  fov: { degrees(): number; choose(degrees: number): void };
  served(): boolean; // there is a server to ask for marks
  marks(): Promise<Marks | null>;
  cells: { known(): boolean; shown(): boolean; show(shown: boolean): void };
  pace: { factor(): number; choose(factor: number): void };
}

interface Part {
  element: HTMLElement;
  refresh(): void;
}

export class Panel {
  readonly element = make("div", { class: "panel" });
  readonly #legend = make("p", { class: "legend" });
  readonly #buttons: HTMLElement; // made once: each of them watches the actions as long as the page lives
  #parts: Part[] = [];

  constructor(private readonly targets: PanelTargets) {
    const names = ["statistics", "share", "picture", "full", "help"];
    this.#buttons = make("div", { class: "actions" }, ...names.map((id) => actionButton(targets.actions, id, true)));
  }

  /** Build the panel anew for a scene. */
  fill(header: Header | null): void {
    const { targets } = this;
    const viewer = targets.viewer();
    this.#parts = [];
    const add = (part: Part): HTMLElement => (this.#parts.push(part), part.element);
    const sections: Node[] = [];
    if (viewer && header) {
      const paints = this.#paints(header);
      sections.push(
        add(choices("paint", "Color shows", paints, () => viewer.paint, (paint) => void this.#setPaint(paint), "chips")),
        this.#legend,
      );
      if (header.levels.length > 1) sections.push(this.levels(viewer, header, add));
      const detailed = header.terms > 0 || header.harmonics !== null;
      if (detailed || targets.cells.known()) sections.push(section("Parts",
        detailed ? add(toggle("View-dependent color", "Highlights that change as you move",
          () => viewer.termsShown, (shown) => void (viewer.termsShown = shown))) : null,
        targets.cells.known()
          ? add(toggle("Cells", "The boxes that visible sets are made for", targets.cells.shown, targets.cells.show))
          : null,
        targets.served() ? null : make("p", { class: "legend" }, NOT_SERVED),
      ));
    }
    const { fov, pace, theme } = targets;
    sections.push(
      section("Camera",
        add(
          slider(
            "fov", "Field of view", { low: 20, high: 110, step: 1, text: (x) => `${Math.round(x)}°` }, fov.degrees,
            fov.choose,
          ),
        ),
        add(slider("pace", "Pace", { low: -2, high: 2, step: 0.5, text: (x) => `${Number((2 ** x).toFixed(2))} ×` },
          () => Math.log2(pace.factor()), (x) => pace.choose(2 ** x))),
      ),
      section("Appearance", add(choices<Theme>("theme", "Appearance", [
        { value: "auto", label: "System" }, { value: "light", label: "Light" }, { value: "dark", label: "Dark" },
      ],
        () => theme.chosen, (chosen) => theme.choose(chosen)))),
      this.#buttons,
    );
    this.element.replaceChildren(...sections);
    this.refresh();
  }

  refresh(): void {
    for (const part of this.#parts) part.refresh();
    const viewer = this.targets.viewer();
    if (viewer) this.#showLegend(viewer.paint);
  }

  #paints(header: Header): typeof PAINTS {
    const celled = this.targets.cells.known() && this.targets.served();
    return PAINTS.filter(({ marked, fits }) => (marked ? celled : !fits || fits(header)));
  }

  /** Take the next way to color. */
  async nextPaint(): Promise<string | null> {
    const viewer = this.targets.viewer();
    if (!viewer?.header) return null;
    const paints = this.#paints(viewer.header), at = paints.findIndex((paint) => paint.value === viewer.paint);
    const next = paints[(at + 1) % paints.length];
    await this.#setPaint(next.value);
    return next.label;
  }

  async #setPaint(paint: Paint): Promise<void> {
    const viewer = this.targets.viewer();
    if (viewer) viewer.paint = paint;
    if (viewer && PAINTS.some(({ value, marked }) => value === paint && marked) && !viewer.marks[paint]) {
      viewer.marks = (await this.targets.marks()) ?? {};
    }
    this.refresh();
    this.targets.actions.changed();
  }

  #showLegend(paint: Paint): void {
    const { text, low, high } = LEGENDS[paint];
    const ramp = make("i", { class: `ramp ${paint}` });
    const bar = low ? make("span", { class: "bar" }, make("small", {}, low), ramp, make("small", {}, high)) : null;
    this.#legend.replaceChildren(make("span", {}, text), ...(bar ? [bar] : []));
  }

  private levels(viewer: ViewerLike, header: Header, add: (part: Part) => HTMLElement): HTMLElement {
    const rows = header.levels.map((level, i) => {
      const change = (shown: boolean): void => {
        const next = [...viewer.levelsShown];
        next[i] = shown;
        viewer.levelsShown = next;
      };
      const row = add(
        toggle(level.name, `${formatCount(level.count)} Gaussians`, () => viewer.levelsShown[i] ?? true, change),
      );
      const dot = make("i", { class: "dot" });
      dot.style.setProperty("background", levelColor(i, header.levels.length));
      row.prepend(dot);
      return row;
    });
    return section("Levels", ...rows);
  }
}

function section(title: string, ...content: (Node | null)[]): HTMLElement {
  return make("section", {}, make("h3", {}, title), ...content);
}
