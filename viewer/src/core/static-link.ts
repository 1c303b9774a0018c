// The link to the files as it shows while requests are under way: bytes a second, and the least time of a request.

const START = 250e3; // bytes a second, assumed before the first bytes
const WINDOW = 0.1; // seconds of one measurement
const WEIGHT = 0.4; // of the last measurement in the mean

export class Link {
  throughput = START;
  roundTrip = 0.05;
  #under = 0;
  #since = 0;
  #pending = 0; // bytes since `since`
  #measured = false;

  /** `now` returns seconds. */
  constructor(private readonly now: () => number) {}

  /** Run a request and measure it; one that was `begun` before says nothing of round trips. */
  async measure<T>(request: () => Promise<T>, begun = false): Promise<T> {
    const began = this.now();
    if (this.#under++ === 0) [this.#since, this.#pending] = [began, 0];
    try {
      const found = await request(), took = this.now() - began;
      if (!begun) [this.roundTrip, this.#measured] = [this.#measured ? Math.min(this.roundTrip, took) : took, true];
      return found;
    } finally {
      this.#under--;
      this.#settle();
    }
  }

  /** Count bytes that have arrived. */
  add(count: number): void {
    this.#pending += count;
  }

  #settle(): void {
    const seconds = this.now() - this.#since;
    if (seconds < WINDOW || this.#pending === 0) return;
    this.throughput += WEIGHT * (this.#pending / seconds - this.throughput);
    [this.#since, this.#pending] = [this.now(), 0];
  }
}
