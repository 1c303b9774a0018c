// Batches on their way to the GPU: long ones in pieces, so that frames come between them.
import type { Batch } from "./types.ts";

const PIECE = 8192; // Gaussians
const TURN_MS = 6; // of the main thread, until others have a turn

/**
 * Return a batch as pieces of at most `most` Gaussians, each copied when it is called for, so that no turn copies all.
 * Terms come with the last of them, or after it in pieces of their own, of twice as many; what is gone comes with the
 * last piece.
 */
export function splitBatch(batch: Batch, most = PIECE): (() => Batch)[] {
  const count = batch.ids.length, total = batch.owners.length, pieces: (() => Batch)[] = [], none = new Uint32Array(0);
  const few = total <= 2 * most;
  if (count <= most && few) return [() => batch];
  const add = (low: number, high: number, from: number, to: number): void => {
    const isFirst = pieces.length === 0;
    pieces.push(() => ({
      first: batch.first + low, ids: batch.ids.slice(low, high), records: batch.records.slice(4 * low, 4 * high),
      rows: batch.rows.slice(low, high), means: batch.means.slice(3 * low, 3 * high),
      firstRow: batch.firstRow + (isFirst ? 0 : batch.chunks.length / 8),
      chunks: isFirst ? batch.chunks : new Float32Array(0), boxes: isFirst ? batch.boxes : new Float32Array(0),
      chunkLevels: isFirst ? batch.chunkLevels : new Uint8Array(0),
      firstTerm: batch.firstTerm + from, terms: batch.terms.slice(2 * from, 2 * to), owners: batch.owners.slice(from, to),
      gone: high === count && to === total ? batch.gone : none,
      labels: batch.labels && batch.labels.slice(low, high),
    }));
  };
  for (let low = 0; low < count; low += most) {
    add(low, Math.min(low + most, count), 0, few && low + most >= count ? total : 0);
  }
  for (let from = 0; from < total && !few; from += 2 * most) add(count, count, from, Math.min(from + 2 * most, total));
  return pieces;
}

/** Hands batches on in order, a few milliseconds at a time. Timers do it, so that it goes on in hidden tabs. */
export class Intake {
  #pieces: (() => Batch)[] = [];
  #timer = 0;

  constructor(private readonly take: (batch: Batch) => void) {}

  /** Whether anything has not been handed on. */
  get isBusy(): boolean { return this.#pieces.length > 0; }

  add(batch: Batch): void {
    this.#pieces.push(...splitBatch(batch));
    if (!this.#timer) this.#turn();
  }

  /** Forget what has not been handed on. */
  clear(): void {
    clearTimeout(this.#timer);
    this.#timer = 0;
    this.#pieces = [];
  }

  #turn = (): void => {
    const begin = performance.now();
    this.#timer = 0;
    for (let next; (next = this.#pieces.shift()); ) {
      this.take(next());
      if (performance.now() - begin > TURN_MS) break;
    }
    if (this.isBusy) this.#timer = setTimeout(this.#turn, 0) as unknown as number;
  };
}
