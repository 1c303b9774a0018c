// What the network Worker does: one `Connection`, orders from the page in, events for it out. The arrays of batches move.
import { Connection } from "./connection.ts";
import type { Clock, ConnectionOptions, Socket } from "./connection.ts";
import { REAL_TIME } from "./traffic.ts";
import type { Batch, Header, Pose, SourceState, Traffic, View } from "./types.ts";

/** From the page. */
export type Order =
  | { kind: "start"; options: ConnectionOptions }
  | { kind: "pose"; pose: Pose }
  | { kind: "view"; view: View }
  | { kind: "retry" }
  | { kind: "online" }
  | { kind: "close" };

/** To the page. */
export type Report =
  | { kind: "header"; header: Header; fresh: boolean }
  | { kind: "batch"; batch: Batch }
  | { kind: "state"; state: SourceState }
  | { kind: "traffic"; traffic: Traffic };

/** Return what takes orders; it reports through `post`. */
export function host(post: (report: Report, moved: ArrayBuffer[]) => void, connect: (url: string) => Socket, clock: Clock): (order: Order) => void {
  let connection: Connection | null = null;
  let view: View | null = null, pose: Pose | null = null;
  return (order) => {
    if (order.kind === "view") view = order.view;
    if (order.kind === "pose") pose = order.pose;
    if (order.kind === "start" && connection === null) {
      connection = new Connection(order.options, {
        header: (header, fresh) => post({ kind: "header", header, fresh }, []),
        batch: (batch) => post({ kind: "batch", batch }, buffersOf(batch)),
        state: (state) => post({ kind: "state", state }, []),
        traffic: (traffic) => post({ kind: "traffic", traffic }, []),
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

function buffersOf(batch: Batch): ArrayBuffer[] {
  const found = new Set<ArrayBuffer>();
  for (const value of Object.values(batch) as unknown[]) {
    if (ArrayBuffer.isView(value) && value.buffer instanceof ArrayBuffer) found.add(value.buffer);
  }
  return [...found];
}

/** Time and chance of a browser or of node. */
export const REAL_CLOCK: Clock = { ...REAL_TIME, wall: () => Date.now(), random: () => Math.random() };
