// The main thread's side of the sort Worker: what is asked of it, and what comes back.
import type { Pick } from "./picking.ts";
import type { Region } from "./sorting.ts";
import type { Batch, Camera, Header } from "./types.ts";

export type SortRequest =
  | { kind: "reset"; header: Header }
  | { kind: "append"; batch: Batch }
  | { kind: "sort"; camera: Camera; region: Region; room: Uint32Array | null }
  | { kind: "pick"; number: number; camera: Camera; x: number; y: number; levels: number }
  | { kind: "content"; number: number };

export type SortAnswer =
  | { kind: "order"; order: Uint32Array; count: number; camera: Camera; milliseconds: number; places: number }
  | { kind: "picked"; number: number; pick: Pick | null }
  | { kind: "content"; number: number; batch: Batch }
  | { kind: "renumbered"; number: number; slots: Uint32Array | null } // before the content
  | { kind: "complete"; number: number } // after it
  | { kind: "failed"; message: string };

/** Starts the Worker; a page in one file passes its own. */
export type WorkerStart = () => Worker;

const startWorker: WorkerStart = () => new Worker(new URL("./sort.js", import.meta.url), { type: "module" });

export class Sorter {
  readonly #worker: Worker;
  readonly #picks = new Map<number, (pick: Pick | null) => void>();
  readonly #rooms: Uint32Array[] = [];
  #picked = 0;
  #asked = 0; // number of the last question for the content
  #isFilling = false; // and whether its answer is still wanted
  #sorting = false;
  onOrder: (answer: Extract<SortAnswer, { kind: "order" }>) => void = () => {};
  onContent: (batch: Batch) => void = () => {};
  onRenumbered: (slots: Uint32Array | null) => void = () => {};
  onComplete: () => void = () => {};
  onFailure: (message: string) => void = () => {};

  constructor(start: WorkerStart = startWorker) {
    this.#worker = start();
    this.#worker.onmessage = (event: MessageEvent<SortAnswer>) => this.#receive(event.data);
    this.#worker.onerror = (event) => {
      this.#answerPicks();
      this.onFailure(`the sort Worker failed: ${event.message || "it could not be started"}`);
    };
  }

  get sorting(): boolean { return this.#sorting; }

  reset(header: Header): void {
    this.forget();
    this.#post({ kind: "reset", header });
  }

  /** Give a batch away; its arrays may not be used after this. */
  append(batch: Batch): void {
    const buffers = [
      batch.records, batch.rows, batch.ids, batch.chunks, batch.boxes, batch.chunkLevels, batch.terms, batch.owners,
      batch.gone, batch.labels,
    ];
    const owned = new Set<ArrayBuffer>();
    for (const array of buffers) if (array && array.buffer.byteLength) owned.add(array.buffer as ArrayBuffer);
    this.#post({ kind: "append", batch: { ...batch, means: new Float32Array(0) } }, [...owned]);
  }

  sort(camera: Camera, region: Region): void {
    this.#sorting = true;
    const room = this.#rooms.pop() ?? null;
    this.#post({ kind: "sort", camera, region, room }, room ? [room.buffer as ArrayBuffer] : []);
  }

  /** Give back the array of an order that the GPU has. */
  recycle(order: Uint32Array): void {
    if (this.#rooms.length < 1) this.#rooms.push(order);
  }

  pick(camera: Camera, x: number, y: number, levels: number): Promise<Pick | null> {
    return new Promise((resolve) => {
      const number = ++this.#picked;
      this.#picks.set(number, resolve);
      this.#post({ kind: "pick", number, camera, x, y, levels });
    });
  }

  /** Ask for all that has arrived, without what was replaced. What was asked before is not passed on any more. */
  content(): void {
    this.#isFilling = true;
    this.#post({ kind: "content", number: ++this.#asked });
  }

  /** Pass on nothing more of the content that was asked for. */
  forget(): void {
    this.#isFilling = false;
  }

  close(): void {
    this.#worker.terminate();
    this.#answerPicks();
  }

  #answerPicks(): void {
    for (const resolve of this.#picks.values()) resolve(null);
    this.#picks.clear();
  }

  #post(request: SortRequest, transfer: ArrayBuffer[] = []): void {
    this.#worker.postMessage(request, transfer);
  }

  #receive(answer: SortAnswer): void {
    if (answer.kind === "order") {
      this.#sorting = false;
      this.onOrder(answer);
    } else if (answer.kind === "picked") {
      this.#picks.get(answer.number)?.(answer.pick);
      this.#picks.delete(answer.number);
    } else if (answer.kind === "failed") {
      this.#sorting = false;
      this.#answerPicks();
      this.onFailure(answer.message);
    } else if (this.#isFilling && answer.number === this.#asked) this.#fill(answer);
  }

  #fill(answer: Extract<SortAnswer, { kind: "renumbered" | "content" | "complete" }>): void {
    if (answer.kind === "renumbered") this.onRenumbered(answer.slots);
    else if (answer.kind === "content") this.onContent(answer.batch);
    else {
      this.#isFilling = false;
      this.onComplete();
    }
  }
}
