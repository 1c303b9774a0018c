// Immersive sessions, where the browser offers them.

import type { XrSession } from "../core/index.ts";

/** What this page uses of `navigator.xr`. */
export interface XrSystem extends EventTarget {
  isSessionSupported(mode: string): Promise<boolean>;
  requestSession(mode: string): Promise<XrSession & { end(): Promise<void> }>;
}

const MODE = "immersive-vr";

/** The immersive session of the page. A headset may come or go at any time; the browser is asked again then. */
export class Immersion {
  offered = false;
  #session: { end(): Promise<void> } | null = null;
  readonly #changed: () => void;
  readonly #system: XrSystem | null;

  /** `changed` is called when what is offered has changed. */
  constructor(changed: () => void, system: XrSystem | null = (navigator as Navigator & { xr?: XrSystem }).xr ?? null) {
    this.#changed = changed;
    this.#system = system;
    void this.#ask();
    system?.addEventListener?.("devicechange", () => void this.#ask());
  }

  /** Ask the browser whether it offers immersive sessions now. */
  async #ask(): Promise<void> {
    let offered = false;
    try {
      offered = await this.#system?.isSessionSupported(MODE) ?? false;
    } catch {
      // refused here: not offered
    }
    if (offered === this.offered) return;
    this.offered = offered;
    this.#changed();
  }

  get on(): boolean {
    return this.#session !== null;
  }

  /** Enter a session and show it with `enter` until it ends; leave the one that is on. */
  async toggle(enter: (session: XrSession) => Promise<void>): Promise<void> {
    if (this.#session) return this.#session.end();
    if (!this.#system) return;
    const session = await this.#system.requestSession(MODE);
    this.#session = session;
    try {
      await enter(session);
    } catch (error) {
      await session.end().catch(() => undefined); // else the headset stays in a session that shows nothing
      throw error;
    } finally {
      this.#session = null;
    }
  }
}
