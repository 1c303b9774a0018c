// Immersive sessions, where the browser offers them.

import type { XrSession } from "../core/index.ts";

interface XrSystem {
  isSessionSupported(mode: string): Promise<boolean>;
  requestSession(mode: string): Promise<XrSession & { end(): Promise<void> }>;
}

const MODE = "immersive-vr";

export class Immersion {
  offered = false;
  #session: { end(): Promise<void> } | null = null;
  readonly #system = (navigator as Navigator & { xr?: XrSystem }).xr;

  constructor(changed: () => void) {
    this.#system?.isSessionSupported(MODE).then(
      (offered) => {
        this.offered = offered;
        changed();
      },
      () => undefined, // not allowed here: not offered
    );
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
