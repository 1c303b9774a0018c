// Answers a click on the scene: which Gaussian is there, and why; marks the place until the view moves.

import type { Header } from "../core/types.ts";
import { make } from "./dom.ts";
import type { Facts } from "./facts.ts";
import { NOT_SERVED } from "./messages.ts";
import type { Side } from "./side.ts";
import type { ViewerLike } from "./viewer-like.ts";
import { describePick, describeWhy } from "./why-card.ts";
import type { Place } from "./why-card.ts";

interface InspectorTargets {
  side: Side;
  facts(): Facts;
  viewer(): ViewerLike | null;
  header(): Header | null;
  place(): Place;
  speak(text: string): void;
}

const TITLE = "Why is this here?";

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
      side.open("why", TITLE, note("Nothing is here: no Gaussian reaches this pixel."));
      return;
    }
    this.mark.style.setProperty("left", `${x}px`);
    this.mark.style.setProperty("top", `${y}px`);
    this.mark.hidden = false;
    speak(`Gaussian ${pick.id}`);
    const summary = describePick(pick, this.targets.header());
    if (!facts.known) return side.open("why", TITLE, summary, note(NOT_SERVED));
    const pending = note("Asking the server …");
    side.open("why", TITLE, summary, pending);
    const [why, cells] = await Promise.all([facts.why(pick.id), facts.cells()]);
    if (!pending.isConnected) return;
    pending.replaceWith(
      ...(why ? describeWhy(why, pick, cells, this.targets.place()) : [note("The server knows no more about it.")])
    );
  }
}

function note(text: string): HTMLElement {
  return make("p", { class: "empty" }, text);
}
