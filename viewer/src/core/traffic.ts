// What has been received so far, and how fast of late.

const WINDOW_MS = 2000;
const REPORT_MS = 250; // between two reports

/** Time that tests move by hand; `after` returns what cancels it. */
export interface Clock {
  now(): number; // milliseconds, never falling
  after(milliseconds: number, work: () => void): () => void;
}

/** The time of a browser or of node. */
export const REAL_TIME: Clock = {
  now: () => performance.now(),
  after: (milliseconds, work) => {
    const timer = setTimeout(work, milliseconds);
    return () => clearTimeout(timer);
  },
};

/** Counts bytes, and reports them and their rate until the rate is 0 again. */
export class Meter {
  bytes = 0;
  readonly #recent: { at: number; bytes: number }[] = [];
  #cancel: (() => void) | null = null;

  constructor(private readonly clock: Clock, private readonly say: (bytes: number, rate: number) => void) {}

  /** Add a message that has arrived. */
  add(bytes: number): void {
    const now = this.clock.now(), last = this.#recent.at(-1);
    this.bytes += bytes;
    if (last !== undefined && now - last.at < WINDOW_MS / 50) last.bytes += bytes;
    else this.#recent.push({ at: now, bytes });
  }

  /** Report soon. */
  touch(): void {
    this.#cancel ??= this.clock.after(REPORT_MS, () => this.report());
  }

  /** Report now, and again while bytes have come of late. */
  report(): void {
    this.stop();
    const rate = this.#rate();
    this.say(this.bytes, rate);
    if (rate > 0) this.touch();
  }

  /** Report nothing more. */
  stop(): void {
    this.#cancel?.();
    this.#cancel = null;
  }

  /** Return bytes a second of the last two seconds. */
  #rate(): number {
    const now = this.clock.now();
    while (this.#recent.length > 0 && now - this.#recent[0].at > WINDOW_MS) this.#recent.shift();
    const sum = this.#recent.reduce((total, entry) => total + entry.bytes, 0);
    return sum === 0 ? 0 : (1000 * sum) / Math.max(Math.min(now - this.#recent[0].at, WINDOW_MS), WINDOW_MS / 20);
  }
}
