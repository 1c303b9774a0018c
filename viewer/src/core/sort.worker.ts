// The sort Worker: keeps what has arrived, sorts it for a camera, finds what lies under a pixel.
import { pickAt } from "./picking.ts";
import type { SortAnswer, SortRequest } from "./sorter.ts";
import { SortedScene } from "./sorting.ts";
import { tablesOf, type Tables } from "./tables.ts";

const port = self as unknown as DedicatedWorkerGlobalScope;
let scene = new SortedScene("rgb");
let tables: Tables | null = null;

function answer(message: SortAnswer, transfer: Transferable[] = []): void {
  port.postMessage(message, transfer);
}

function serve(request: SortRequest): void {
  if (request.kind === "reset") {
    const { colors, harmonics } = request.header;
    scene = new SortedScene(colors.variant, harmonics !== null);
    tables = tablesOf(colors);
  } else if (request.kind === "append") scene.append(request.batch);
  else if (request.kind === "sort") {
    const begin = performance.now(), { camera, region, room } = request;
    const { order, count } = scene.sort(camera, region, room);
    const milliseconds = performance.now() - begin;
    answer({ kind: "order", order, count, camera, milliseconds, places: scene.count }, [order.buffer as ArrayBuffer]);
  } else if (request.kind === "pick") {
    const { number, camera, x, y, levels } = request;
    answer({ kind: "picked", number, pick: tables ? pickAt(scene, tables, camera, x, y, levels) : null });
  } else {
    const { number } = request, { batches, slots } = scene.compact();
    answer({ kind: "renumbered", number, slots }, slots ? [slots.buffer as ArrayBuffer] : []);
    for (const batch of batches) {
      const arrays = [batch.records, batch.rows, batch.ids, batch.chunks, batch.terms, batch.owners, batch.labels];
      const owned = new Set<ArrayBuffer>();
      for (const array of arrays) if (array?.byteLength) owned.add(array.buffer as ArrayBuffer);
      answer({ kind: "content", number, batch }, [...owned]);
    }
    answer({ kind: "complete", number });
  }
}

port.onmessage = (event: MessageEvent<SortRequest>) => {
  try {
    serve(event.data);
  } catch (error) {
    answer({ kind: "failed", message: error instanceof Error ? error.message : String(error) });
  }
};
