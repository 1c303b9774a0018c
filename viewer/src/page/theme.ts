// Dark, light, or as the system has it; the choice is kept in this browser.

import { meta } from "./dom.ts";
import type { Vec3 } from "./vector.ts";

export type Theme = "auto" | "dark" | "light";
const THEMES: readonly Theme[] = ["auto", "dark", "light"];
const KEY = "gsvis-theme";

export class ThemeChoice {
  chosen: Theme = THEMES.find((theme) => theme === read()) ?? "auto";
  readonly #system = matchMedia("(prefers-color-scheme: light)");

  constructor(private readonly changed: () => void) {
    this.#system.addEventListener("change", () => this.#apply());
    this.#apply();
  }

  get dark(): boolean {
    return this.chosen === "dark" || (this.chosen === "auto" && !this.#system.matches);
  }

  /** What lies behind the scene. */
  get background(): Vec3 {
    return this.dark ? [0.043, 0.051, 0.063] : [0.933, 0.937, 0.945];
  }

  choose(theme: Theme): void {
    this.chosen = theme;
    write(theme);
    this.#apply();
  }

  #apply(): void {
    const { dataset, style } = document.documentElement, dark = this.dark;
    dataset.theme = dark ? "dark" : "light";
    const [accent, ink] = meta("accent")?.split(" ").slice(dark ? 0 : 2) ?? [];
    if (ink) (style.setProperty("--accent", accent), style.setProperty("--on-accent", ink));
    this.changed();
  }
}

function read(): string | null {
  try {
    return localStorage.getItem(KEY);
  } catch {
    return null; // storage is switched off
  }
}

function write(theme: Theme): void {
  try {
    localStorage.setItem(KEY, theme);
  } catch {
    // storage is switched off: the choice lasts as long as the page
  }
}
