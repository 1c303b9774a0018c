// The options: what the colors show, levels, terms, cells, field of view, pace, theme, and the actions of small
// screens.

import type { Header, Marks, Paint } from "../core/types.ts";
import type { Actions } from "./actions.ts";
import { actionButton, choices, slider, toggle } from "./controls.ts";
import { make, setText } from "./dom.ts";
import { formatCount, formatGaussians } from "./format.ts";
import { isMarked, legendOf, levelColor, paintsOf } from "./paints.ts";
import type { PaintChoice } from "./paints.ts";
import { QUALITIES } from "./quality.ts";
import type { Quality, QualityChoice } from "./quality.ts";
import type { Theme } from "./theme.ts";
import type { ViewerLike } from "./viewer-like.ts";
import { text } from "./words.ts";

interface PanelTargets {
  viewer: () => ViewerLike | null;
  actions: Actions;
  theme: { chosen: Theme; choose(theme: Theme): void };
  fov: { degrees(): number; choose(degrees: number): void };
  served(): boolean; // there is a server to ask for marks
  marks(): Promise<Marks | null>;
  cells: { known(): boolean; shown(): boolean; show(shown: boolean): void };
  quality: QualityChoice;
  pace: { factor(): number; choose(factor: number): void };
}

interface Part {
  element: HTMLElement;
  refresh(): void;
}

export class Panel {
  readonly element = make("div", { class: "panel" });
  readonly #legend = make("p", { class: "legend" });
  readonly #quality = make("p", { class: "legend" });
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
        add(choices("paint", text("options.paint"), paints, () => viewer.paint, (paint) => void this.#setPaint(paint), "chips")),
        this.#legend,
      );
      if (header.levels.length > 1) sections.push(this.levels(viewer, header, add));
      const detailed = header.terms > 0 || header.harmonics !== null;
      if (detailed || targets.cells.known()) sections.push(section(text("options.parts"),
        detailed ? add(toggle(text("options.detail"), text("options.detail.text"),
          () => viewer.termsShown, (shown) => void (viewer.termsShown = shown))) : null,
        targets.cells.known()
          ? add(toggle(text("options.cells"), text("options.cells.text"), targets.cells.shown, targets.cells.show))
          : null,
        targets.served() ? null : make("p", { class: "legend" }, text("say.served")),
      ));
    }
    const { fov, pace, theme, quality } = targets;
    sections.push(
      section(text("options.quality"),
        add(choices<Quality>("quality", text("options.quality"),
          QUALITIES.map((value) => ({ value, label: text(`quality.${value}`) })), () => quality.chosen,
          (chosen) => (quality.choose(chosen), this.#showQuality()))), this.#quality),
      section(text("options.camera"),
        add(
          slider(
            "fov", text("options.fov"), {
              low: 20, high: 110, step: 1, text: (x) => text("number.degrees", { degrees: Math.round(x) }),
            }, fov.degrees,
            fov.choose,
          ),
        ),
        add(slider("pace", text("options.pace"), {
          low: -2, high: 2, step: 0.5, text: (x) => text("number.times", { factor: 2 ** x }),
        },
          () => Math.log2(pace.factor()), (x) => pace.choose(2 ** x))),
      ),
      section(text("options.appearance"), add(choices<Theme>("theme", text("options.appearance"),
        (["auto", "light", "dark"] as const).map((value) => ({ value, label: text(`theme.${value}`) })),
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
    this.#showQuality();
  }

  #showQuality(): void {
    const { chosen, limits: { budget } } = this.targets.quality;
    const says = chosen === "auto" ? text("quality.auto.text") : budget < Infinity
      ? text("quality.most", { budget: formatCount(budget) }) : text("quality.all");
    setText(this.#quality, says);
  }

  #paints(header: Header): PaintChoice[] {
    return paintsOf(header, this.targets.cells.known() && this.targets.served());
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
    if (viewer && isMarked(paint) && !viewer.marks[paint]) {
      viewer.marks = (await this.targets.marks()) ?? {};
    }
    this.refresh();
    this.targets.actions.changed();
  }

  #showLegend(paint: Paint): void {
    const { says, low, high } = legendOf(paint);
    const ramp = make("i", { class: `ramp ${paint}` });
    const bar = low ? make("span", { class: "bar" }, make("small", {}, low), ramp, make("small", {}, high)) : null;
    this.#legend.replaceChildren(make("span", {}, says), ...(bar ? [bar] : []));
  }

  private levels(viewer: ViewerLike, header: Header, add: (part: Part) => HTMLElement): HTMLElement {
    const rows = header.levels.map((level, i) => {
      const change = (shown: boolean): void => {
        const next = [...viewer.levelsShown];
        next[i] = shown;
        viewer.levelsShown = next;
      };
      const row = add(
        toggle(level.name, formatGaussians(level.count), () => viewer.levelsShown[i] ?? true, change),
      );
      const dot = make("i", { class: "dot" });
      dot.style.setProperty("background", levelColor(i, header.levels.length));
      row.prepend(dot);
      return row;
    });
    return section(text("options.levels"), ...rows);
  }
}

function section(title: string, ...content: (Node | null)[]): HTMLElement {
  return make("section", {}, make("h3", {}, title), ...content);
}
