// What the network Worker does: one `Connection`, orders from the page in, events for it out. The arrays of batches
// move.
import { Connection } from "./connection.ts";
import type { Clock, ConnectionOptions, Socket } from "./connection.ts";
import { REAL_TIME } from "./traffic.ts";
import type { Pose, View } from "./types.ts";
import { buffersOf, type Order, type Report } from "./worker-source.ts";

/** Of a stream alone: try again at once. */
export interface Retry {
  kind: "retry";
}

/** From the page, and from the Worker itself when the device is on a network again. */
export type NetworkOrder = Order<{ options: ConnectionOptions }, Retry | { kind: "online" }>;

/** Return what takes orders; it reports through `post`. */
export function host(
  post: (report: Report, moved: ArrayBuffer[]) => void, connect: (url: string) => Socket, clock: Clock,
): (order: NetworkOrder) => void {
  const say = (report: Report): void => post(report, buffersOf(report));
  let connection: Connection | null = null;
  let view: View | null = null, pose: Pose | null = null;
  return (order) => {
    if (order.kind === "view") view = order.view;
    if (order.kind === "pose") pose = order.pose;
    if (order.kind === "start" && connection === null) {
      connection = new Connection(order.options, {
        header: (header, fresh) => say({ kind: "header", header, fresh }),
        batch: (batch) => say({ kind: "batch", batch }),
        state: (state) => say({ kind: "state", state }),
        traffic: (traffic) => say({ kind: "traffic", traffic }),
      }, connect, clock);
      if (view !== null) connection.setView(view);
      if (pose !== null) connection.setPose(pose);
      connection.start();
    } else if (order.kind === "view") connection?.setView(order.view);
    else if (order.kind === "pose") connection?.setPose(order.pose);
    else if (order.kind === "retry") connection?.retry();
    else if (order.kind === "online") connection?.renew();
    else if (order.kind === "close") connection?.close();
  };
}

/** Time and chance of a browser or of node. */
export const REAL_CLOCK: Clock = { ...REAL_TIME, wall: () => Date.now(), random: () => Math.random() };
