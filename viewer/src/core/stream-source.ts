// A source that streams from a gsvis server. The socket and the decoding are in a Worker; this end passes messages on.
import type { Order, Report } from "./network.host.ts";
import { MOST_BYTES } from "./receiver.ts";
import type { Pose, Source, SourceEvents, View } from "./types.ts";
import { isToken } from "./wire.ts";

/** Options of `streamSource`. */
export interface StreamOptions {
  token?: string; // where the server asks for one and no cookie of it is set
  margin?: number; // radians around the view that are sent as if they were in it
  near?: number; // distance at which the view begins, scene units
  mostBytes?: number; // most memory for tables of a scene before its first Gaussian
  worker?: () => Worker; // makes the network Worker where `network.js` does not lie beside this module
}

/** A stream; `retry` tries again at once while the source waits. */
export interface StreamSource extends Source {
  retry(): void;
}

const MARGIN = 0.14;
const NEAR = 0.01;

/** Return a source for the address of a stream, such as `/stream/NAME`, of this page's host or another. */
export function streamSource(url: string | URL, options: StreamOptions = {}): StreamSource {
  let worker: Worker | null = null;
  let lastPose = "", isClosed = false;
  const waiting = new Map<string, Order>();
  const order = (what: Order) => {
    if (worker === null) waiting.set(what.kind, what);
    else worker.postMessage(what);
  };
  return {
    start(events: SourceEvents): void {
      const fail = (message: string) => {
        if (!isClosed) events.state({ kind: "failed", message });
        isClosed = true;
      };
      const address = addressOf(url);
      if (typeof address !== "string") return fail(address.message);
      const token = options.token ?? null;
      if (token !== null && !isToken(token)) return fail("The token has characters that no token has.");
      try {
        worker = options.worker?.() ?? new Worker(new URL("network.js", import.meta.url), { type: "module", name: "gsvis network" });
      } catch (error) {
        return fail(`The browser does not start the network Worker: ${(error as Error).message}`);
      }
      worker.onerror = (event) => fail(`The network Worker failed${event.message ? `: ${event.message}` : " to load."}`);
      worker.onmessage = (event: MessageEvent<Report>) => {
        if (!isClosed) pass(event.data, events);
      };
      const reach = { margin: options.margin ?? MARGIN, near: options.near ?? NEAR };
      worker.postMessage({ kind: "start", options: { url: address, token, reach, mostBytes: options.mostBytes ?? MOST_BYTES } } satisfies Order);
      for (const what of waiting.values()) worker.postMessage(what);
      waiting.clear();
    },
    pose(pose: Pose): void {
      const said = [...pose.position, ...pose.rotation].join(" ");
      if (said === lastPose) return;
      lastPose = said;
      order({ kind: "pose", pose: { position: [...pose.position], rotation: [...pose.rotation] } });
    },
    view: ({ left, right, up, down }: View) => order({ kind: "view", view: { left, right, up, down } }),
    retry: () => order({ kind: "retry" }),
    close(): void {
      isClosed = true;
      worker?.postMessage({ kind: "close" } satisfies Order); // it ends itself once BYE has left
      worker = null;
    },
  };
}

function pass(report: Report, events: SourceEvents): void {
  if (report.kind === "header") events.header(report.header, report.fresh);
  else if (report.kind === "batch") events.batch(report.batch);
  else if (report.kind === "state") events.state(report.state);
  else events.traffic(report.traffic);
}

/** Return the address as ws: or wss:, or an error that a person understands. */
function addressOf(url: string | URL): string | Error {
  let found: URL;
  try {
    found = new URL(url, globalThis.location?.href);
  } catch {
    return new Error(`This is no address of a stream: ${String(url).slice(0, 200)}`);
  }
  const kinds: Record<string, string> = { "http:": "ws:", "https:": "wss:", "ws:": "ws:", "wss:": "wss:" };
  const kind = kinds[found.protocol];
  if (kind === undefined) return new Error(`Streams come over ws: or wss:, not ${found.protocol}`);
  found.protocol = kind;
  found.hash = "";
  return found.href;
}
