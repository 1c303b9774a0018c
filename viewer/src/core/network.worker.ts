// The Worker with the socket: decoding and acknowledgements never wait for drawing.
import { host, REAL_CLOCK } from "./network.host.ts";
import type { NetworkOrder } from "./network.host.ts";
import type { Socket } from "./connection.ts";

declare const self: DedicatedWorkerGlobalScope;

const CLOSE_MS = 500; // for BYE to leave

const take = host(
  (report, moved) => self.postMessage(report, moved), (url) => new WebSocket(url) as Socket, REAL_CLOCK,
);
let wasOffline = false;
self.onmessage = (event: MessageEvent<NetworkOrder>) => {
  take(event.data);
  if (event.data.kind === "close") setTimeout(() => self.close(), CLOSE_MS);
};
self.addEventListener("offline", () => { wasOffline = true; });
self.addEventListener("online", () => {
  if (wasOffline) take({ kind: "online" });
  wasOffline = false;
});
