// Answers a click on the scene: which Gaussian is there, and why; marks the place until the view moves.

import type { Header } from "../core/types.ts";
import { make } from "./dom.ts";
import type { Facts } from "./facts.ts";
import type { Side } from "./side.ts";
import type { ViewerLike } from "./viewer-like.ts";
import { describePick, describeWhy } from "./why-card.ts";
import type { Place } from "./why-card.ts";
import { text } from "./words.ts";

interface InspectorTargets {
  side: Side;
  facts(): Facts;
  viewer(): ViewerLike | null;
  header(): Header | null;
  place(): Place;
  speak(text: string): void;
}

export class Inspector {
  readonly mark = make("i", { class: "mark", hidden: true, "aria-hidden": "true" });
  on = false; // clicks ask
  #asked = 0;

  constructor(private readonly targets: InspectorTargets) {}

  async inspect(x: number, y: number): Promise<void> {
    const { side, speak } = this.targets;
    const facts = this.targets.facts();
    const viewer = this.targets.viewer();
    const turn = ++this.#asked;
    const pick = await viewer?.pick(x, y);
    if (!viewer || viewer !== this.targets.viewer() || turn !== this.#asked) return;
    if (!pick) {
      side.open("why", text("why.title"), note(text("why.nothing")));
      return;
    }
    this.mark.style.setProperty("left", `${x}px`);
    this.mark.style.setProperty("top", `${y}px`);
    this.mark.hidden = false;
    speak(text("why.gaussian", { id: String(pick.id) }));
    const summary = describePick(pick, this.targets.header());
    if (!facts.known) return side.open("why", text("why.title"), summary, note(text("say.served")));
    const pending = note(text("why.asking"));
    side.open("why", text("why.title"), summary, pending);
    const [why, cells] = await Promise.all([facts.why(pick.id), facts.cells()]);
    if (!pending.isConnected) return;
    pending.replaceWith(
      ...(why ? describeWhy(why, pick, cells, this.targets.place()) : [note(text("why.unknown"))])
    );
  }
}

function note(line: string): HTMLElement {
  return make("p", { class: "empty" }, line);
}
