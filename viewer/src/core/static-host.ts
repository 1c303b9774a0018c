// What the Worker of a static scene does: orders from the page in, events for it out. Reads scene.json anew when files
// are gone.
import { Link } from "./static-link.ts";
import type { PartEvents, Parts } from "./static-parts.ts";
import { parseScene } from "./static-scene.ts";
import { StaticSession } from "./static-session.ts";
import { type Clock, Meter } from "./traffic.ts";
import type { Pose, View } from "./types.ts";
import { isPose, isView } from "./wire.ts";
import type { Report } from "./worker-source.ts";

/** What a page says before its script has run: where a scene is, and the files that its first view needs. */
export interface EarlyStart {
  kind: "ahead";
  base: string;
  names: string[];
}

/** Where a scene is: its address, and the files that the page itself holds. */
export interface StaticStart {
  base: string;
  held: Map<string, Blob> | null;
}

const AGAIN_MS = 30_000; // before scene.json is read anew

export class StaticHost {
  readonly #stop = new AbortController();
  readonly #link: Link;
  readonly #parts: Parts;
  #session: StaticSession | null = null;
  #pose: Pose | null = null;
  #view: View | null = null;
  #looked = -Infinity;
  #restarts = 0;
  readonly #meter: Meter;

  constructor(
    private readonly post: (report: Report) => void, private readonly clock: Clock,
    make: (events: PartEvents, stop: AbortSignal) => Parts,
  ) {
    this.#link = new Link(() => clock.now() / 1000);
    this.#meter = new Meter(clock, (bytes, rate) => this.#report(bytes, rate));
    this.#parts = make({
      bytes: (count) => {
        this.#link.add(count);
        this.#meter.add(count);
        this.#meter.touch();
      },
      waiting: (seconds, message) => this.post({ kind: "state", state: { kind: "waiting", seconds, message } }),
      resumed: () => this.#session?.report(),
    }, this.#stop.signal);
  }

  /** Ask for files before the page has chosen its view. */
  ahead(names: readonly string[]): void {
    this.#parts.ahead?.(names);
  }

  /** Open the scene; report a failure in one line. */
  async start(): Promise<void> {
    this.post({ kind: "state", state: { kind: "connecting" } });
    try {
      await this.#open(await this.#parts.scene());
    } catch (error) {
      this.#fail(error);
    }
  }

  setPose(pose: Pose): void {
    if (!isPose(pose)) return;
    this.#pose = pose;
    this.#session?.setPose(pose);
  }

  setView(view: View): void {
    if (!isView(view)) return;
    this.#view = view;
    this.#session?.setView(view);
  }

  close(): void {
    this.#session?.close();
    this.#stop.abort();
    this.#meter.stop();
  }

  async #open(text: string): Promise<void> {
    const scene = parseScene(text);
    this.post({ kind: "header", header: scene.header, fresh: true });
    const mine = (): boolean => this.#session === session && !this.#stop.signal.aborted;
    const session: StaticSession = new StaticSession(scene, this.#parts, this.#link, {
      header: () => undefined,
      batch: (batch) => {
        if (!mine()) return;
        this.post({ kind: "batch", batch });
        this.#meter.touch();
      },
      sets: (first, sets) => { if (mine()) this.post({ kind: "sets", first, sets }); },
      state: (state) => { if (mine()) this.post({ kind: "state", state }); },
      traffic: () => undefined,
      gone: () => { if (mine()) void this.#renew(); },
    });
    this.#session = session;
    session.report();
    if (this.#view !== null) session.setView(this.#view);
    if (this.#pose !== null) session.setPose(this.#pose);
    await session.start();
  }

  /** A file is missing: perhaps the site was written anew under the same address. */
  async #renew(): Promise<void> {
    const before = this.#session;
    if (before === null || this.clock.now() - this.#looked < AGAIN_MS) return;
    this.#looked = this.clock.now();
    let text: string;
    try {
      text = await this.#parts.scene();
      if (parseScene(text).header.identity === before.scene.header.identity || this.#session !== before) return;
    } catch {
      before.report(); // the scene goes on without what is missing
      return;
    }
    this.#restarts++;
    before.close();
    try {
      await this.#open(text);
    } catch (error) {
      this.#fail(error);
    }
  }

  #report(bytes: number, rate: number): void {
    const got = this.#session?.arrived;
    this.post({
      kind: "traffic",
      traffic: {
        bytes, rate, gaussians: got?.gaussians ?? 0, terms: got?.terms ?? 0, replaced: 0,
        reconnects: this.#restarts,
      },
    });
  }

  #fail(error: unknown): void {
    if (this.#stop.signal.aborted) return;
    this.post(
      { kind: "state", state: { kind: "failed", message: error instanceof Error ? error.message : String(error) } }
    );
  }
}
