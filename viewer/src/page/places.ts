// Where a visit begins, and where it goes: the views of a scene, the one of the address, and the angle of the window.

import { begin, fovOf, rigFromView, viewsFromPoses } from "./begin.ts";
import type { Beginning, Surroundings } from "./begin.ts";
import { readHash, readUp, writeHash } from "./hash.ts";
import type { View } from "./hash.ts";
import type { Mode, Navigator } from "./navigator.ts";
import type { Rig } from "./rig.ts";
import type { Vec3 } from "./vector.ts";
import { text } from "./words.ts";

interface PlacesPage {
  navigator: Navigator;
  setMode(mode: Mode): void;
  wake(): void;
  jumped(): void;
  say(line: string): void;
  went(view: View, index: number): void; // to a view that has a number
}

export class Places {
  readonly up: Vec3 | null = readUp(location.hash);
  isBegun = false;
  #views: readonly View[] = [];
  #view = 0;
  #start: Rig | null = null;
  #ownHash = "";
  #lens: { view: Pick<View, "fov" | "longer">; fovY: number } | null = null; // of the last view that was gone to

  constructor(private readonly page: PlacesPage) {}

  get count(): number {
    return this.#views.length;
  }

  /** The name of the view that was gone to, or its number. */
  get label(): string {
    return this.#views[this.#view]?.name ?? text("bar.view", { number: this.#view + 1, count: this.count });
  }

  /** Stand where the visit begins; return how it begins. */
  begin(views: readonly View[], around: Surroundings): Beginning {
    const { navigator } = this.page, first = begin(location.hash, views, navigator.frame, around);
    this.#lens = { view: first.view, fovY: first.rig.fovY };
    this.#views = views.length ? views : viewsFromPoses(around.poses);
    this.isBegun = true;
    const mode = first.mode === "walk" && !navigator.canStandAt(first.rig.eye) ? "fly" : first.mode;
    navigator.mode = mode;
    navigator.place(first.rig);
    this.#start = begin("", views, navigator.frame, around).rig;
    return { ...first, mode };
  }

  /** Take other views; whoever looks stays. */
  take(views: readonly View[]): void {
    this.#views = views;
    this.#view = Math.min(this.#view, Math.max(views.length - 1, 0));
  }

  /** Keep the angle of the view that was gone to as the shape of the window changes. */
  fit(): void {
    const lens = this.#lens, { navigator } = this.page;
    if (!lens || navigator.shown.fovY !== lens.fovY) return;
    navigator.setFov((lens.fovY = fovOf(lens.view)));
    this.page.wake();
  }

  /** Fly to a view; jump there where `now`. */
  go(view: View, now = false): void {
    if (view.mode) this.page.setMode(view.mode);
    if (now) this.page.navigator.place(this.#rigOf(view));
    else this.page.navigator.flyTo(this.#rigOf(view));
    if (now) this.page.jumped();
    this.page.wake();
  }

  goToView(index: number): void {
    const view = this.#views[index], { navigator } = this.page;
    if (!view) return;
    this.#view = index;
    if (navigator.mode === "walk" && !navigator.canStandAt(view.eye)) this.page.setMode("fly");
    navigator.flyTo(this.#rigOf(view));
    this.page.went(view, index);
    this.page.wake();
  }

  step(by: number): void {
    this.goToView((this.#view + by + this.count) % Math.max(this.count, 1));
  }

  goHome(): void {
    if (this.#start) this.page.navigator.flyTo(this.#start);
    this.#view = 0;
    this.page.wake();
  }

  /** Write the view into the address. */
  write(): void {
    const { shown, frame, mode } = this.page.navigator;
    if (!this.isBegun) return;
    this.#ownHash = writeHash(shown, frame, mode, this.up);
    try {
      history.replaceState(null, "", this.#ownHash);
    } catch {
      // too many changes for this browser, or a page from a disk: the view is not in the address
    }
  }

  /** Go to the view of an address that somebody else has changed. */
  follow(): void {
    if (location.hash === this.#ownHash) return;
    const asked = readHash(location.hash);
    if (asked instanceof Error) this.page.say(text("say.hash"));
    else if (asked) this.go(asked);
  }

  /** Return where a view stands, and keep its angle. */
  #rigOf(view: View): Rig {
    const rig = rigFromView(view, this.page.navigator.frame);
    this.#lens = { view, fovY: rig.fovY };
    return rig;
  }
}
