// What settings bring to a page beside its views: an animation with its controls, hotspots, and the panel of authors.
// Each is a script of its own, which is loaded where it is needed.

import { reasonOf } from "./keep.ts";
import { part } from "./parts.ts";
import { readSettings } from "./settings.ts";
import type { Settings } from "./settings.ts";
import type { Side } from "./side.ts";
import type { Player, Stage } from "./stage.ts";
import { text } from "./words.ts";

interface ExtrasPage {
  side: Side;
  overlay: HTMLElement; // hotspots lie above it
  dock: HTMLElement; // controls of an animation lie above it
  stage(): Stage;
  say(line: string): void;
}

export class Extras {
  settings: Settings = { views: [], background: null, spots: false, animated: false, plays: false };
  said: unknown = null; // settings as they were read
  player: Player | null = null;
  #author: HTMLElement | null = null;

  constructor(private readonly page: ExtrasPage) {}

  /** Read the settings at an address; what is wrong with them is said, and stops nothing. */
  async load(address: string | null): Promise<void> {
    if (!address) return;
    try {
      const response = await fetch(address);
      if (!response.ok) throw new Error(text("say.settings.status", { status: String(response.status) }));
      await this.apply(await response.json().catch(() => null)); // what is no JSON is no object
    } catch (error) {
      this.page.say(text("say.settings", { reason: reasonOf(error) }).trim());
    }
  }

  /** Take settings; no picture waits for their hotspots. */
  async apply(said: unknown): Promise<void> {
    this.settings = readSettings(said);
    this.said = said;
    await this.#showTimeline(said);
    if (this.settings.spots || document.querySelector(".spots")) void this.#showSpots(said);
  }

  /** Open or close the panel of authors; it is made once. */
  async toggleAuthor(): Promise<void> {
    const { side } = this.page;
    if (side.shows("author")) return void side.close();
    this.#author ??= (await part("author"))(this.page.stage());
    side.open("author", text("action.author"), this.#author);
  }

  togglePlaying(): void {
    if (this.player?.playing) this.player.pause();
    else this.player?.play();
  }

  /** Show the controls of an animation; where one of earlier settings plays, the new one plays on. */
  async #showTimeline(settings: unknown): Promise<void> {
    const before = this.player, playing = before?.playing === true;
    const player = this.settings.animated ? (await part("tour"))(this.page.stage(), settings) : null;
    before?.pause();
    before?.bar.remove();
    this.player = player;
    if (!player) return;
    this.page.dock.before(player.bar);
    if (before && playing) {
      player.seek(before.seconds);
      player.play();
    }
  }

  async #showSpots(settings: unknown): Promise<void> {
    const show = await part("hotspots");
    document.querySelector(".spots")?.remove();
    this.page.overlay.after(show(this.page.stage(), settings));
  }
}
