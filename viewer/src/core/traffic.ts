// What has been received so far, and how fast of late.

const WINDOW_MS = 2000;

/** Bytes over time. */
export class Meter {
  bytes = 0;
  private readonly recent: { at: number; bytes: number }[] = [];

  /** Add a message that has arrived. */
  add(now: number, bytes: number): void {
    this.bytes += bytes;
    const last = this.recent.at(-1);
    if (last !== undefined && now - last.at < WINDOW_MS / 50) last.bytes += bytes;
    else this.recent.push({ at: now, bytes });
  }

  /** Return bytes a second of the last two seconds. */
  rate(now: number): number {
    while (this.recent.length > 0 && now - this.recent[0].at > WINDOW_MS) this.recent.shift();
    const sum = this.recent.reduce((total, entry) => total + entry.bytes, 0);
    return sum === 0 ? 0 : (1000 * sum) / Math.max(Math.min(now - this.recent[0].at, WINDOW_MS), WINDOW_MS / 20);
  }
}
