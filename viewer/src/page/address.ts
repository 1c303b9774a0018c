// Which scene a page shows: from its meta elements, the query, or the path. All addresses are relative to the page's.
// A page opens its own origin alone, and those that whoever wrote the page names: no link can add one.

import { budgetOf, qualityOf } from "./quality.ts";
import type { Quality } from "./quality.ts";
import { text } from "./words.ts";

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
  token: string | null; // for streams of the page's own origin alone
  bare: boolean; // no interface
  visitor: boolean; // nothing that is for engineers
  permits: Permit;
  still: boolean; // an animation waits until it is asked for
  authors: boolean; // the settings may be edited
  quality: Quality;
  budget: number | null; // most Gaussians in a picture
}

interface Metas {
  scene: string | null; // name of a scene of this server
  content: string | null; // address of a static scene
  settings: string | null;
  visitor?: string | null;
  origins?: string | null; // other origins that the page may open, with spaces between
}

/** Whether a page may open an absolute address. */
export type Permit = (url: string) => boolean;

/**
 * Read the address of a page: `?content=` names a folder of a static scene or a stream, `?settings=` a settings.json.
 */
export function readAddress(href: string, metas: Metas): PageAddress {
  const page = new URL(href), query = page.searchParams, permits = permitOf(href, metas.origins);
  const pick = (key: "content" | "settings"): string | null => {
    const asked = query.get(key), text = asked ?? metas[key];
    return text && resolve(text, href, asked === null ? () => true : permits);
  };
  return {
    scene: query.has("content") || metas.content ? sceneAt(pick("content"), metas.scene) : findScene(page, metas.scene),
    settings: pick("settings"),
    token: query.get("token"),
    permits,
    bare: query.has("noui"),
    visitor: query.has("visitor") || Boolean(metas.visitor),
    still: query.has("noanim"),
    authors: query.has("author"),
    quality: qualityOf(query.get("quality")) ?? "auto",
    budget: budgetOf(query.get("budget")),
  };
}

/**
 * Return which addresses a page may open: those of its own origin and of `origins`, none with a name or a password. A
 * file has no origin, no server and no token: it takes what lies in its link itself.
 */
export function permitOf(href: string, origins?: string | null): Permit {
  const all = [href, ...origins?.split(" ") ?? []].map(originOf);
  return (url) => all.includes(originOf(url) || "none") || (!all[0] && url.startsWith("data:"));
}

/** Return the http: or https: origin of an address, also of a stream; nothing for any other address. */
function originOf(text: string): string | false {
  const { protocol, host, username, password } = new URL(text), kind = protocol.replace("ws", "http");
  return /^https?:$/.test(kind) && !username && !password && kind + host;
}

/** Return the absolute address of a text, or null where it is none or may not be opened. */
export function resolve(text: string, base: string, permits: Permit): string | null {
  try {
    const { href } = new URL(text, base);
    return permits(href) ? href : null;
  } catch {
    return null;
  }
}

function sceneAt(url: string | null, named: string | null): SceneAddress | null {
  if (!url) return null;
  if (/^ws/.test(url)) return { kind: "stream", name: nameOf(url), url, root: null };
  return { kind: "static", name: named ?? nameOf(url), url, root: null };
}

/** Return the scene whose page this is; no path of a page becomes a host. */
function findScene(page: URL, named: string | null): SceneAddress | null {
  const name = named ?? decode(/\/view\/([^/]+)\/?$/.exec(page.pathname)?.[1] ?? "");
  if (!name) return null;
  const root = page.origin + page.pathname.replace(/[^/]*\/[^/]*\/?$/, "");
  return { kind: "stream", name, url: `${root.replace("http", "ws")}stream/${encodeURIComponent(name)}`, root };
}

function nameOf(url: string): string {
  if (url === "inline:") return document.title.replace(/ · gsvis$/, "") || text("page.unnamed");
  const parts = new URL(url).pathname.replace(/\/?(scene\.json|index\.html)?$/, "").split("/");
  return decode(parts.pop() || text("page.unnamed")).replace(/\.(gsvis|json)$/, "").slice(0, 80);
}

function decode(text: string): string {
  try {
    return decodeURIComponent(text);
  } catch {
    return text;
  }
}
