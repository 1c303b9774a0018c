// Which scene a page shows: from its meta elements, the query, or the path. All addresses are relative to the page's.

/** A scene: streamed, or read from files. `root` is its server's first address, null where there is none to ask. */
export interface SceneAddress {
  kind: "stream" | "static";
  name: string;
  url: string;
  root: string | null;
}

export interface PageAddress {
  scene: SceneAddress | null;
  settings: string | null;
  token: string | null;
  bare: boolean; // no interface
  still: boolean; // an animation waits until it is asked for
}

interface Metas {
  scene: string | null; // name of a scene of this server
  content: string | null; // address of a static scene
  settings: string | null;
}

/**
 * Read the address of a page: `?content=` names a folder of a static scene or a stream, `?settings=` a settings.json.
 */
export function readAddress(href: string, metas: Metas): PageAddress {
  const page = new URL(href);
  const query = page.searchParams;
  const given = query.get("settings") ?? metas.settings, asked = query.get("content");
  // A page with an own scene, as exports are, opens others of its site alone: Workers do not heed its policy.
  const other = asked && metas.content ? resolve(asked, page) : null, isAway = other && new URL(other).host !== page.host;
  return {
    scene: isAway ? null : findScene(page, asked ?? metas.content, metas.scene),
    settings: given ? resolve(given, page) : null,
    token: query.get("token"),
    bare: query.has("noui"),
    still: query.has("noanim"),
  };
}

function findScene(page: URL, content: string | null, named: string | null): SceneAddress | null {
  if (content) {
    const url = resolve(content, page);
    if (!url) return null;
    if (/^wss?:/.test(url)) return { kind: "stream", name: nameOf(url), url, root: null };
    return { kind: "static", name: named ?? nameOf(url), url, root: null };
  }
  const name = named ?? /\/view\/([^/]+)\/?$/.exec(page.pathname)?.[1] ?? null;
  if (!name) return null;
  const plain = named ?? decode(name);
  const root = new URL(page.pathname.replace(/[^/]*\/?$/, "") + "../", page);
  const stream = new URL(`stream/${encodeURIComponent(plain)}`, root);
  stream.protocol = stream.protocol === "https:" ? "wss:" : "ws:";
  return { kind: "stream", name: plain, url: stream.href, root: root.href };
}

/** Return an absolute address, or null for one that no page should open. */
function resolve(text: string, page: URL): string | null {
  if (text === "inline:") return text; // held by the page itself
  try {
    const url = new URL(text, page);
    return /^(https?|wss?|file|blob|data):$/.test(url.protocol) ? url.href : null;
  } catch {
    return null;
  }
}

function nameOf(url: string): string {
  if (url === "inline:") return document.title.replace(/ · gsvis$/, "") || "Scene";
  const parts = new URL(url).pathname.split("/").filter((part) => part && !/^(scene\.json|index\.html)$/.test(part));
  return decode(parts.at(-1) ?? "Scene").replace(/\.(gsvis|json)$/, "").slice(0, 80);
}

function decode(text: string): string {
  try {
    return decodeURIComponent(text);
  } catch {
    return text;
  }
}
