// The page's end of a source whose work is in a Worker: orders go in, reports come out, and the Worker ends with the
// source.
import type { Batch, Header, Pose, Source, SourceEvents, SourceState, Traffic, View } from "./types.ts";

/** From the page; `Start` is what the Worker needs to begin, `More` what else it understands. */
export type Order<Start, More = never> =
  | ({ kind: "start" } & Start)
  | { kind: "pose"; pose: Pose }
  | { kind: "view"; view: View }
  | { kind: "close" }
  | More;

/** To the page. */
export type Report =
  | { kind: "header"; header: Header; fresh: boolean }
  | { kind: "batch"; batch: Batch }
  | { kind: "sets"; first: number; sets: Uint8Array }
  | { kind: "state"; state: SourceState }
  | { kind: "traffic"; traffic: Traffic };

/** What a source is made of. `begin` returns what the Worker needs, or why there is nothing to begin with. */
interface Work<Start> {
  title: string; // of the Worker, in messages
  make(): Worker;
  begin(): Start | Error;
}

/** A source, and `tell` for orders beyond those of every source. */
interface WorkerSource<More> extends Source {
  tell(order: More): void;
}

/** Return a source that starts its Worker when it is started itself. */
export function workerSource<Start extends object, More extends { kind: string } = never>(
  work: Work<Start>,
): WorkerSource<More> {
  type Own = Order<Start, More>;
  let worker: Worker | null = null, isClosed = false, lastPose = "";
  const waiting = new Map<string, Own>();
  const tell = (order: Own): void => {
    if (worker !== null) worker.postMessage(order);
    else if (!isClosed) waiting.set(order.kind, order);
  };
  const close = (): void => {
    isClosed = true;
    worker?.postMessage({ kind: "close" } satisfies Own); // it ends itself once it has said what is to be said
    worker = null;
  };
  const start = (events: SourceEvents): void => {
    const fail = (message: string): void => {
      if (!isClosed) events.state({ kind: "failed", message });
      isClosed = true;
      worker?.terminate();
      worker = null;
    };
    const begun = work.begin();
    if (begun instanceof Error) return fail(begun.message);
    try {
      worker = work.make();
    } catch (error) {
      return fail(`The browser does not start ${work.title}: ${(error as Error).message}`);
    }
    const title = work.title[0].toUpperCase() + work.title.slice(1);
    worker.onerror = (event) => fail(`${title} failed${event.message ? `: ${event.message}` : " to load."}`);
    worker.onmessage = (event: MessageEvent<Report>) => {
      if (isClosed) return;
      pass(event.data, events);
      if (event.data.kind === "state" && event.data.state.kind === "failed") close(); // it does not try again
    };
    tell({ kind: "start", ...begun });
    for (const order of waiting.values()) tell(order);
    waiting.clear();
  };
  return {
    start, close, tell,
    pose: ({ position, rotation }: Pose): void => {
      const said = [...position, ...rotation].join(" ");
      if (said === lastPose) return;
      lastPose = said;
      tell({ kind: "pose", pose: { position: [...position], rotation: [...rotation] } });
    },
    view: ({ left, right, up, down }: View) => tell({ kind: "view", view: { left, right, up, down } }),
  };
}

function pass(report: Report, events: SourceEvents): void {
  if (report.kind === "header") events.header(report.header, report.fresh);
  else if (report.kind === "batch") events.batch(report.batch);
  else if (report.kind === "sets") events.sets?.(report.first, report.sets);
  else if (report.kind === "state") events.state(report.state);
  else events.traffic(report.traffic);
}

/** Return what moves with a report from the Worker: the arrays of a batch or of sets, each buffer once. */
export function buffersOf(report: Report): ArrayBuffer[] {
  const found = new Set<ArrayBuffer>(), said = report.kind === "batch" ? report.batch : report;
  for (const value of Object.values(said) as unknown[]) {
    if (ArrayBuffer.isView(value) && value.buffer instanceof ArrayBuffer) found.add(value.buffer);
  }
  return [...found];
}
