// A source that reads a static scene (docs/static.md) from any file server, or from the page itself; the work is in a
// Worker.
import type { StaticStart } from "./static-host.ts";
import type { Source } from "./types.ts";
import { workerSource } from "./worker-source.ts";

/** Options of `staticSource`. */
export interface StaticOptions {
  worker?: () => Worker; // makes the Worker where `static.js` does not lie beside this module
}

/** The address of a scene that the page holds itself, as the pages of `gsvis export --format html` do. */
const INLINE = "inline:";

// Written out, so that bundlers of other pages find the file.
const startWorker = (): Worker => new Worker(
  new URL("static.js", import.meta.url), { type: "module", name: "gsvis static" },
);

/** Return a source for the folder of a static scene, or for its scene.json. */
export function staticSource(url: string | URL, options: StaticOptions = {}): Source {
  const begin = (): StaticStart | Error => {
    const base = baseOf(url);
    if (base === null) return new Error(`This is no address of a scene: ${String(url).slice(0, 200)}`);
    return { base, held: base === INLINE ? filesOfPage() : null };
  };
  return workerSource<StaticStart>({
    title: "the Worker that reads the scene", make: options.worker ?? startWorker, begin,
  });
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
