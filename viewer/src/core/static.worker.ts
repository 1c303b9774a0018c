// The Worker that reads a static scene: planning and decoding never wait for drawing.
import { StaticHost } from "./static-host.ts";
import type { EarlyStart, StaticStart } from "./static-host.ts";
import { HeldParts, HttpParts } from "./static-parts.ts";
import { REAL_TIME } from "./traffic.ts";
import { buffersOf, type Order, type Report } from "./worker-source.ts";

declare const self: DedicatedWorkerGlobalScope;

let host: StaticHost | null = null;

self.onmessage = (event: MessageEvent<Order<StaticStart, EarlyStart>>) => {
  const order = event.data;
  if (order.kind === "ahead") {
    host = makeHost(order.base, null);
    host.ahead(order.names);
  } else if (order.kind === "start") {
    host ??= makeHost(order.base, order.held);
    void host.start();
  } else if (order.kind === "pose") host?.setPose(order.pose);
  else if (order.kind === "view") host?.setView(order.view);
  else {
    host?.close();
    self.close();
  }
};

function makeHost(base: string, held: Map<string, Blob> | null): StaticHost {
  return new StaticHost(post, REAL_TIME, (events, stop) =>
    held === null ? new HttpParts(base, events, stop) : new HeldParts(held, events));
}

function post(report: Report): void {
  self.postMessage(report, buffersOf(report));
}
