// Which Gaussians and terms the page's reader of static scenes has after how many bytes, on a link of a given rate and
// round trip. Blocks of sets of harmonics are steps without Gaussians, which name their first set.
// node static-trace.mjs FOLDER RATE ROUND_TRIP BYTES < poses.json: for each pose and view one JSON line of arrivals; of
// terms the slot of their owner, and the lower and the upper word of their record, behind each other.
import { readFileSync } from "node:fs";
import { join } from "node:path";
import { StaticHost } from "../src/core/static-host.ts";
import type { Report } from "../src/core/worker-source.ts";
import type { PartEvents, Parts } from "../src/core/static-parts.ts";
import type { Pose, View } from "../src/core/types.ts";

const SLICE = 8 << 10; // bytes of a file that is read while it comes

/** Files behind a link that carries one answer after the other; time is simulated. */
class LinkedParts implements Parts {
  now = 0;
  requests = 0;
  bytes = 0;
  readonly kinds: Record<string, number> = {}; // bytes of each kind of file
  private free = 0; // when the link has carried all that was asked for
  private readonly files = new Map<string, Uint8Array>();
  private readonly due: { at: number; resolve: () => void }[] = [];

  constructor(
    private readonly folder: string, private readonly events: PartEvents, private readonly rate: number,
    private readonly trip: number,
  ) {}

  async scene(): Promise<string> {
    const data = readFileSync(join(this.folder, "scene.json"));
    await this.carry("scene", data.length);
    return data.toString();
  }

  async read(name: string, bytes: number, take?: (data: Uint8Array) => void): Promise<Uint8Array> {
    const data = new Uint8Array(this.file(name)), step = take ? SLICE : bytes;
    for (let at = 0; at < bytes; at += step) {
      const some = data.slice(at, at + step);
      await this.carry(name.split("-")[0], some.length, at === 0);
      take?.(some);
    }
    return data;
  }

  private file(name: string): Uint8Array {
    let data = this.files.get(name);
    if (data === undefined) this.files.set(name, (data = readFileSync(join(this.folder, name))));
    return data;
  }

  private carry(kind: string, bytes: number, isAsked = true): Promise<void> {
    if (isAsked) this.requests++;
    this.free = Math.max(this.free, this.now + (isAsked ? this.trip : 0)) + bytes / this.rate;
    const at = this.free;
    return new Promise((done) => {
      this.due.push({ at, resolve: () => {
        this.bytes += bytes;
        this.kinds[kind] = (this.kinds[kind] ?? 0) + bytes;
        this.events.bytes(bytes);
        done();
      } });
    });
  }

  get isIdle(): boolean { return this.due.length === 0; }

  /** Let the next answer arrive; return whether there was one. */
  step(): boolean {
    const next = this.due.shift();
    if (next === undefined) return false;
    this.now = next.at;
    next.resolve();
    return true;
  }
}

const [folder, rate, trip, most] = [
  process.argv[2], Number(process.argv[3]), Number(process.argv[4]), Number(process.argv[5]),
];
for (const { pose, view } of JSON.parse(readFileSync(0, "utf8")) as { pose: Pose; view: View }[]) {
  const steps: {
    bytes: number; requests: number; seconds: number; kinds: Record<string, number>; ids: number[]; terms: number[];
    gone: number[]; sets: number[];
  }[] = [];
  let parts: LinkedParts | null = null, isComplete = false;
  const post = (report: Report): void => {
    if (report.kind === "state") isComplete = report.state.kind === "complete";
    if (report.kind !== "batch" && report.kind !== "sets") return;
    const at = { bytes: parts!.bytes, requests: parts!.requests, seconds: parts!.now, kinds: { ...parts!.kinds } };
    if (report.kind === "sets") {
      steps.push({ ...at, ids: [], terms: [], gone: [], sets: [report.first] });
      return;
    }
    const { ids, owners, terms, gone } = report.batch;
    steps.push(
      {
        ...at, ids: [...ids], gone: [...gone], sets: [],
        terms: [...owners].flatMap((slot, k) => [slot, terms[2 * k], terms[2 * k + 1]]),
      }
    );
  };
  const host = new StaticHost(
    post, { now: () => 1000 * (parts?.now ?? 0), after: () => () => undefined },
    (events) => (parts = new LinkedParts(folder, events, rate, trip)),
  );
  host.setView(view);
  host.setPose(pose);
  void host.start();
  // What is unpacked takes turns of other threads, so nothing is under way only after a while without a request.
  const settle = async (): Promise<void> => {
    for (let k = 0; k < 12 || (parts!.isIdle && !isComplete && k < 200); k++) {
      await new Promise((done) => { k < 8 ? setImmediate(done) : setTimeout(done, 2); });
    }
  };
  await settle();
  while (!isComplete && parts!.bytes < most && parts!.step()) await settle();
  host.close();
  process.stdout.write(`${JSON.stringify(steps)}\n`);
}
