// The main thread's side of the sort Worker, with a Worker that answers when it is told to.
import assert from "node:assert/strict";
import { test } from "node:test";
import { type SortAnswer, Sorter, type SortRequest } from "../src/core/sorter.ts";
import type { Batch, Header } from "../src/core/types.ts";

class FakeWorker {
  readonly requests: SortRequest[] = [];
  onmessage: ((event: MessageEvent<SortAnswer>) => void) | null = null;
  onerror: ((event: ErrorEvent) => void) | null = null;

  postMessage(request: SortRequest): void {
    this.requests.push(request);
  }

  terminate(): void {}

  answer(data: SortAnswer): void {
    this.onmessage?.({ data } as MessageEvent<SortAnswer>);
  }
}

/** A sorter, its Worker, and a word for all that it has passed on of contents. */
function begin(): { sorter: Sorter; worker: FakeWorker; said: string[] } {
  const worker = new FakeWorker(), sorter = new Sorter(() => worker as unknown as Worker), said: string[] = [];
  sorter.onRenumbered = (slots) => said.push(`renumbered ${slots?.length ?? "none"}`);
  sorter.onContent = (batch) => said.push(`content ${batch.first}`);
  sorter.onComplete = () => said.push("complete");
  return { sorter, worker, said };
}

const batch = (first: number): Batch => ({ first }) as Batch;
const numberOf = (worker: FakeWorker): number => {
  const last = worker.requests.at(-1);
  return last?.kind === "content" ? last.number : -1;
};

test("only the answer to the last question for the content is passed on, each part once", () => {
  const { sorter, worker, said } = begin();
  sorter.content();
  const old = numberOf(worker);
  worker.answer({ kind: "renumbered", number: old, slots: null });
  sorter.content();
  const now = numberOf(worker);
  worker.answer({ kind: "content", number: old, batch: batch(1) });
  worker.answer({ kind: "complete", number: old });
  worker.answer({ kind: "renumbered", number: now, slots: new Uint32Array(3) });
  worker.answer({ kind: "content", number: now, batch: batch(2) });
  worker.answer({ kind: "complete", number: now });
  worker.answer({ kind: "complete", number: now });
  assert.deepEqual(said, ["renumbered none", "renumbered 3", "content 2", "complete"]);
});

test("the content of a scene that is no longer shown, or of a lost GPU, is not passed on", () => {
  for (const end of [(sorter: Sorter) => sorter.reset({} as Header), (sorter: Sorter) => sorter.forget()]) {
    const { sorter, worker, said } = begin();
    sorter.content();
    const number = numberOf(worker);
    end(sorter);
    worker.answer({ kind: "renumbered", number, slots: null });
    worker.answer({ kind: "content", number, batch: batch(0) });
    worker.answer({ kind: "complete", number });
    assert.deepEqual(said, []);
  }
});

test("a Worker that fails or ends answers all picks with nothing", async () => {
  const ends = [
    (worker: FakeWorker) => worker.answer({ kind: "failed", message: "no" }),
    (worker: FakeWorker) => worker.onerror?.({ message: "no" } as ErrorEvent),
    (_: FakeWorker, sorter: Sorter) => sorter.close(),
  ];
  for (const end of ends) {
    const { sorter, worker } = begin(), picks = [1, 2].map((x) => sorter.pick({} as never, x, x, 1));
    end(worker, sorter);
    assert.deepEqual(await Promise.all(picks), [null, null]);
  }
});
