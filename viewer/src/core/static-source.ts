// A source that reads a static scene (docs/static.md) from any file server, or from the page itself; the work is in a Worker.
import type { Order, Report } from "./static-host.ts";
import type { Pose, Source, SourceEvents, View } from "./types.ts";

/** Options of `staticSource`. */
export interface StaticOptions {
  worker?: () => Worker; // makes the Worker where `static.js` does not lie beside this module
}

/** The address of a scene that the page holds itself, as the pages of `gsvis export --format html` do. */
export const INLINE = "inline:";

/** Return a source for the folder of a static scene, or for its scene.json. */
export function staticSource(url: string | URL, options: StaticOptions = {}): Source {
  let worker: Worker | null = null;
  let isClosed = false, lastPose = "";
  const waiting = new Map<string, Order>();
  const order = (what: Order): void => {
    if (worker === null) waiting.set(what.kind, what);
    else worker.postMessage(what);
  };
  return {
    start(events: SourceEvents): void {
      const fail = (message: string): void => {
        if (!isClosed) events.state({ kind: "failed", message });
        isClosed = true;
      };
      const base = baseOf(url);
      if (base === null) return fail(`This is no address of a scene: ${String(url).slice(0, 200)}`);
      try {
        worker = options.worker?.() ?? new Worker(new URL("static.js", import.meta.url), { type: "module", name: "gsvis static" });
      } catch (error) {
        return fail(`The browser does not start the Worker that reads the scene: ${(error as Error).message}`);
      }
      worker.onerror = (event) => fail(`The Worker that reads the scene failed${event.message ? `: ${event.message}` : " to load."}`);
      worker.onmessage = (event: MessageEvent<Report>) => {
        if (!isClosed) pass(event.data, events);
      };
      worker.postMessage({ kind: "start", base, held: base === INLINE ? filesOfPage() : null } satisfies Order);
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
    close(): void {
      isClosed = true;
      worker?.postMessage({ kind: "close" } satisfies Order);
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

/** Return the address that names of files are relative to; null for none that can be read. */
export function baseOf(url: string | URL, page: string | undefined = globalThis.location?.href): string | null {
  if (String(url) === INLINE) return INLINE;
  try {
    const found = new URL(url, page);
    if (!/^(https?|file|blob|data):$/.test(found.protocol)) return null;
    found.hash = "";
    if (!/\/[^/]*\.json$/.test(found.pathname) && !found.pathname.endsWith("/")) found.pathname += "/";
    return found.href;
  } catch {
    return null;
  }
}

const held = new Map<string, Blob>();

/** Return the files that the page itself holds, as base64 in elements of type text/gsvis. */
function filesOfPage(): Map<string, Blob> {
  for (const element of document.querySelectorAll<HTMLScriptElement>('script[type="text/gsvis"]')) {
    const pieces: BlobPart[] = [], text = element.textContent ?? "";
    for (let at = 0; at < text.length; at += 1 << 20) {
      pieces.push(Uint8Array.from(atob(text.slice(at, at + (1 << 20))), (letter) => letter.charCodeAt(0)));
    }
    held.set(element.dataset.name ?? "", new Blob(pieces));
    if (text.length > 1 << 16) element.remove(); // the text is larger than the file
  }
  return held;
}
