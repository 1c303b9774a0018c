// The Worker that reads a static scene: planning and decoding never wait for drawing.
import { StaticHost } from "./static-host.ts";
import type { StaticStart } from "./static-host.ts";
import { HeldParts, HttpParts } from "./static-parts.ts";
import { REAL_TIME } from "./traffic.ts";
import { buffersOf, type Order, type Report } from "./worker-source.ts";

declare const self: DedicatedWorkerGlobalScope;

let host: StaticHost | null = null;

self.onmessage = (event: MessageEvent<Order<StaticStart>>) => {
  const order = event.data;
  if (order.kind === "start") {
    host = new StaticHost(post, REAL_TIME, (events, stop) =>
      order.held === null ? new HttpParts(order.base, events, stop) : new HeldParts(order.held, events));
    void host.start();
  } else if (order.kind === "pose") host?.setPose(order.pose);
  else if (order.kind === "view") host?.setView(order.view);
  else {
    host?.close();
    self.close();
  }
};

function post(report: Report): void {
  self.postMessage(report, buffersOf(report));
}
