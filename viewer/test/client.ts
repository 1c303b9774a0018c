// A client for tests/viewer: `stream URL OUT` streams and writes what it draws to OUT at its end; `bitmaps` turns sets
// into bitmaps.
// Lines of JSON come out: what the source says. `pose X Y Z`, `retry` and `end` go in.
import { writeFileSync } from "node:fs";
import { createInterface } from "node:readline";
import { host, REAL_CLOCK } from "../src/core/network.host.ts";
import type { NetworkOrder as Order } from "../src/core/network.host.ts";
import type { Report } from "../src/core/worker-source.ts";
import type { Socket } from "../src/core/connection.ts";
import { add } from "../src/core/bits.ts";
import { serialize } from "../src/core/roaring.ts";
import { streamSource } from "../src/core/stream-source.ts";
import { colorSeen, decodeRecord, decodeTerm, tablesOf } from "../src/core/tables.ts";
import type { Splat, Term } from "../src/core/tables.ts";
import type { Batch, Header } from "../src/core/types.ts";

const say = (event: Record<string, unknown>) => process.stdout.write(`${JSON.stringify(event)}\n`);

let last: WebSocket | null = null;

/** A WebSocket that closes when it could not connect, as in a browser: node 20 only tells of the error. */
function connect(url: string): Socket {
  const socket = last = new WebSocket(url);
  socket.addEventListener("error", () => socket.onclose?.({ code: 1006, reason: "" } as CloseEvent));
  return socket as unknown as Socket;
}

/** End once the server has heard that the client leaves. */
function leave(): void {
  const end = () => process.exit(0);
  if (last === null || last.readyState === WebSocket.CLOSED) end();
  else for (const event of ["close", "error"]) last.addEventListener(event, end);
}

/** A Worker of this thread: what passes is copied or moved as between threads. */
function nearWorker(): Worker {
  const worker = {
    onmessage: null as ((event: MessageEvent<Report>) => void) | null, onerror: null,
    postMessage: (order: Order) => take(structuredClone(order)),
  };
  const post = (report: Report, transfer: ArrayBuffer[]) => {
    const data = structuredClone(report, { transfer });
    worker.onmessage?.({ data } as MessageEvent<Report>);
  };
  const take = host(post, connect, REAL_CLOCK);
  return worker as unknown as Worker;
}

/** Everything that has come, as a renderer would keep it. */
class Kept {
  header: Header | null = null;
  readonly batches: Batch[] = [];

  /** Return what is drawn, by rising ids, with the colors that an eye sees. */
  drawn(eye: [number, number, number]): Record<string, unknown> {
    if (this.header === null) return { ids: [] };
    const { colors } = this.header, tables = tablesOf(colors),
      chunks = Float32Array.from(this.batches.flatMap((batch) => [...batch.chunks]));
    const splats: { id: number; splat: Splat; terms: Term[] }[] = [], gone = new Set<number>();
    for (const batch of this.batches) {
      batch.ids.forEach(
        (id, i) => splats.push({ id, splat: decodeRecord(batch.records, i, chunks, batch.rows[i], tables), terms: [] }),
      );
      batch.owners.forEach((slot, i) => splats[slot].terms.push(decodeTerm(batch.terms, i, tables)));
      batch.gone.forEach((slot) => gone.add(slot));
    }
    const drawn = splats.filter((_, slot) => !gone.has(slot)).sort((a, b) => a.id - b.id);
    const levels = this.batches.flatMap((batch) => [...batch.chunkLevels]);
    return {
      ids: drawn.map(({ id }) => id), came: splats.length, terms: drawn.map(({ terms }) => terms.length),
      levels: levels.length,
      means: drawn.map(({ splat }) => splat.mean), quats: drawn.map(({ splat }) => splat.quat),
      scales: drawn.map(({ splat }) => splat.scale),
      opacities: drawn.map(({ splat }) => splat.opacity),
      rgb: drawn.map(({ splat, terms }) => colorSeen(splat, terms, eye, colors.variant)),
    };
  }
}

function stream(url: string, out: string, token: string | undefined, memory: number): void {
  const kept = new Kept(),
    source = streamSource(url, { worker: nearWorker, memory, ...(token ? { token } : {}) });
  const pose = (position: [number, number, number]) => source.pose({ position, rotation: [1, 0, 0, 0] });
  source.view({ left: 0.84, right: 0.84, up: 0.58, down: 0.58 });
  pose([0, 0, 0]);
  source.start({
    header: (header, fresh) => {
      if (fresh) kept.batches.length = 0;
      kept.header = header;
      say({ event: "header", fresh, gaussians: header.gaussians });
    },
    batch: (batch) => {
      kept.batches.push(batch);
      say({ event: "batch", held: batch.first + batch.ids.length });
    },
    state: (state) => say({ event: "state", ...state }),
    traffic: (traffic) => say({ event: "traffic", ...traffic }),
  });
  createInterface({ input: process.stdin }).on("line", (line) => {
    const [order, ...numbers] = line.split(" ");
    if (order === "pose") pose(numbers.map(Number) as [number, number, number]);
    if (order === "retry") source.retry();
    if (order !== "end") return;
    writeFileSync(out, JSON.stringify(kept.drawn([0.25, -1.5, 0.5])));
    source.close();
    leave();
  });
}

/** Read lines, each a JSON list of ids, and write the bitmap of each in hexadecimal digits. */
function bitmaps(): void {
  createInterface({ input: process.stdin }).on("line", (line) => {
    const ids = JSON.parse(line) as number[],
      set = new Uint32Array(Math.ceil((Math.max(-1, ...ids.slice(-1)) + 1) / 32));
    for (const id of ids) add(set, id);
    process.stdout.write(`${Buffer.from(serialize(set)).toString("hex")}\n`);
  });
}

const [mode, url, out, token, memory] = process.argv.slice(2);
if (mode === "bitmaps") bitmaps();
else stream(url, out, token, Number(memory ?? 0));
