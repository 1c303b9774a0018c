// Hotspots: places of a scene with a title, a text and a link, as buttons over the picture. From the annotations of
// settings.json; a link is `extras.link`, since SuperSplat leaves `extras` free. A script of its own: pages load it
// where their settings have annotations.

import { make, on } from "./dom.ts";
import { LONGER } from "./hash.ts";
import type { View } from "./hash.ts";
import { icon } from "./icons.ts";
import { fields, list, vector } from "./json.ts";
import { offer, textOfPage } from "./parts.ts";
import { project } from "./project.ts";
import type { Place } from "./project.ts";
import { FOV_DEGREES } from "./rig.ts";
import type { Stage } from "./stage.ts";
import { clamp, distance } from "./vector.ts";
import type { Vec3 } from "./vector.ts";

const MOST = 99;
const FARTHEST = 1e6; // of a coordinate, as on the wire
const REST_MS = 250; // until a view counts as resting, and walls are looked for
const IN_FRONT = 0.97; // of the way to a hotspot, what hides it ends

/** A place with something to say. */
export interface Spot {
  at: Vec3;
  title: string;
  text: string;
  link: string | null;
  view: View | null; // to look at it from
}

/** Return the hotspots of settings; what makes no sense is left out. */
export function spotsOf(settings: unknown): Spot[] {
  const all = fields(settings), own = all?.frame === "scene";
  const place = (value: unknown): Vec3 | null => {
    const at = vector(value, FARTHEST);
    return at && (own ? at : [-at[0], -at[1], at[2]]);
  };
  return list(all?.annotations, MOST).flatMap((each): Spot[] => {
    const it = fields(each), at = place(it?.position), pose = fields(fields(it?.camera)?.initial);
    const [eye, to] = [place(pose?.position), place(pose?.target)];
    const fov = typeof pose?.fov === "number" && Number.isFinite(pose.fov) ? clamp(pose.fov, ...FOV_DEGREES) : 60;
    const view = eye && to && distance(eye, to) > 1e-9 ? { eye, to, fov, ...(own ? {} : LONGER) } : null;
    const title = textOf(it?.title, 80), text = textOf(it?.text, 2000);
    return at && (title || text) ? [{ at, title, text, link: linkOf(fields(it?.extras)?.link), view }] : [];
  });
}

function textOf(value: unknown, most: number): string {
  return typeof value === "string" ? value.trim().slice(0, most) : "";
}

/** Return a link that a page may offer: to a site, or to write a mail. */
function linkOf(value: unknown): string | null {
  try {
    const { href, protocol } = new URL(String(value));
    return /^(https?|mailto):$/.test(protocol) ? href : null;
  } catch {
    return null;
  }
}

class Hotspots {
  readonly element = make("div", { class: "spots" });
  readonly #card = make("section", { class: "spot-card", "aria-live": "polite", hidden: true });
  readonly #buttons: HTMLButtonElement[];
  #timer = 0;
  #turn = 0; // of looking for walls
  #open: number | null = null;

  constructor(private readonly stage: Stage, private readonly spots: readonly Spot[]) {
    this.#buttons = spots.map((spot, i) => {
      const name = make("span", { class: "spot-name" }, spot.title || spot.text.slice(0, 40));
      const button = make("button", { type: "button", class: "spot", hidden: true, "aria-expanded": "false" },
        make("span", { class: "spot-number" }, String(i + 1)), name);
      on(button, "click", () => (this.#open === i ? this.#close() : this.#show(i)));
      return button;
    });
    this.element.append(...this.#buttons, this.#card);
    this.element.addEventListener("keydown", (event) => event.key === "Escape" && this.#close());
    stage.follow((resting) => void (this.element.isConnected && this.#follow(resting)));
    this.#follow(true);
  }

  #follow(resting: boolean): void {
    this.spots.forEach((spot, i) => {
      const place = this.#placeOf(spot), button = this.#buttons[i];
      button.hidden = place === null || button.dataset.behind !== undefined;
      if (place) button.style.translate = `${place.x}px ${place.y}px`;
    });
    clearTimeout(this.#timer);
    this.#timer = window.setTimeout(() => void this.#lookForWalls(), resting ? 0 : REST_MS);
  }

  /** Return where a spot is drawn, null where it is not in the picture. */
  #placeOf(spot: Spot): Place | null {
    const { view, up, width, height, of } = this.stage.look();
    const place = of ? project(spot.at, view, up, width, height) : null;
    return place && place.x > 0 && place.y > 0 && place.x < width && place.y < height ? place : null;
  }

  /** Hide spots that lie behind something, and show those that do not any more. */
  async #lookForWalls(): Promise<void> {
    const turn = ++this.#turn;
    for (const [i, spot] of this.spots.entries()) {
      const place = this.#placeOf(spot), button = this.#buttons[i];
      if (!place) continue;
      const found = await this.stage.find(place.x, place.y);
      if (turn !== this.#turn) return;
      const behind = found !== null && found.depth < IN_FRONT * place.depth && this.#open !== i;
      button.toggleAttribute("data-behind", behind);
      button.hidden = behind;
    }
  }

  #show(i: number): void {
    const { title, text, link, view } = this.spots[i];
    const close = make("button", { type: "button", class: "tool", "aria-label": textOfPage("spot.close") }, icon("close"));
    on(close, "click", () => this.#close());
    this.#card.replaceChildren(
      make("header", {}, make("h2", {}, title), close), text ? make("p", {}, text) : "",
      link ? make("a", { href: link, target: "_blank", rel: "noopener noreferrer" }, new URL(link).host || link) : "",
    );
    this.#card.hidden = false;
    this.#mark(i);
    if (view) this.stage.go({ ...view, mode: "orbit" });
    document.dispatchEvent(new CustomEvent("gsvis-hotspot", { detail: { index: i, title, text, link } }));
  }

  #close(): void {
    this.#card.hidden = true;
    const was = this.#open;
    this.#mark(null);
    if (was !== null) this.#buttons[was].focus();
  }

  #mark(open: number | null): void {
    this.#open = open;
    this.#buttons.forEach((button, i) => button.setAttribute("aria-expanded", String(i === open)));
  }
}

offer("hotspots", (stage, settings) => new Hotspots(stage, spotsOf(settings)).element);
