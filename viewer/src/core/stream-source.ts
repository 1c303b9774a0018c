// A source that streams from a gsvis server. The socket and the decoding are in a Worker.
import type { ConnectionOptions } from "./connection.ts";
import type { Retry } from "./network.host.ts";
import { MOST_BYTES } from "./receiver.ts";
import type { Source } from "./types.ts";
import { isToken } from "./wire.ts";
import { workerSource } from "./worker-source.ts";

/** Options of `streamSource`. */
export interface StreamOptions {
  token?: string; // where the server asks for one and no cookie of it is set
  margin?: number; // radians around the view that are sent as if they were in it
  near?: number; // distance at which the view begins, scene units
  mostBytes?: number; // most memory for tables of a scene before its first Gaussian
  memory?: number; // bytes of records to hold at most: what is farthest from use goes; 0 for no limit
  worker?: () => Worker; // makes the network Worker where `network.js` does not lie beside this module
}

/** A stream; `retry` tries again at once while the source waits. */
export interface StreamSource extends Source {
  retry(): void;
}

const MARGIN = 0.14;
const NEAR = 0.01;

// Written out, so that bundlers of other pages find the file.
const startWorker = (): Worker => new Worker(
  new URL("network.js", import.meta.url), { type: "module", name: "gsvis network" },
);

/** Return a source for the address of a stream, such as `/stream/NAME`, of this page's host or another. */
export function streamSource(url: string | URL, options: StreamOptions = {}): StreamSource {
  const begin = (): { options: ConnectionOptions } | Error => {
    const address = addressOf(url), token = options.token ?? null;
    if (address instanceof Error) return address;
    if (token !== null && !isToken(token)) return new Error("The token has characters that no token has.");
    const memory = Math.max(Math.floor(options.memory ?? 0), 0);
    const reach = { margin: options.margin ?? MARGIN, near: options.near ?? NEAR, memory };
    return { options: { url: address, token, reach, mostBytes: options.mostBytes ?? MOST_BYTES } };
  };
  const { tell, ...source } = workerSource<{ options: ConnectionOptions }, Retry>({
    title: "the network Worker", make: options.worker ?? startWorker, begin,
  });
  return { ...source, retry: () => tell({ kind: "retry" }) };
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
