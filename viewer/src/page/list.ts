// The page of all scenes of a server.

import { make, setText } from "./dom.ts";
import { formatGaussians } from "./format.ts";
import { icon } from "./icons.ts";
import { ThemeChoice } from "./theme.ts";
import { speakLanguage, text } from "./words.ts";

interface ListedScene {
  name: string;
  href: string;
  gaussians: number | null;
}

/** Read the scenes from the JSON that a server gives at its root. */
export function readScenes(json: unknown): ListedScene[] {
  const all = typeof json === "object" && json !== null && "scenes" in json ? json.scenes : json;
  const rows: [string, unknown][] = Array.isArray(all) ? all.map((row) => [nameOf(row), row])
    : typeof all === "object" && all !== null ? Object.entries(all) : [];
  return rows.filter(([name]) => name).map(
    ([name, row]) => ({ name, href: `view/${encodeURIComponent(name)}`, gaussians: countOf(row) }),
  );
}

function nameOf(row: unknown): string {
  if (typeof row === "string") return row;
  return typeof row === "object" && row !== null && "name" in row && typeof row.name === "string" ? row.name : "";
}

function countOf(row: unknown): number | null {
  return typeof row === "object" && row !== null && "gaussians" in row &&
    typeof row.gaussians === "number" ? row.gaussians : null;
}

export async function showList(): Promise<void> {
  new ThemeChoice(() => undefined);
  await speakLanguage();
  document.title = text("page.title", { name: text("list.title") });
  setText(document.querySelector("h1")!, text("list.title"));
  const list = document.querySelector("#scenes");
  const state = document.querySelector("#state");
  if (!list || !state) return;
  setText(state, text("list.loading"));
  try {
    const response = await fetch(location.href, { headers: { accept: "application/json" } });
    if (!response.ok) throw new Error(text("list.answered", { status: String(response.status) }));
    const scenes = readScenes(await response.json());
    list.replaceChildren(...scenes.map(row));
    setText(state, scenes.length === 0 ? text("list.empty") : "");
  } catch (error) {
    setText(state, text("list.failed", { reason: error instanceof Error ? error.message : String(error) }));
  }
}

function row(scene: ListedScene): HTMLLIElement {
  const count = scene.gaussians === null ? null : make("small", {}, formatGaussians(scene.gaussians));
  return make(
    "li", {}, make("a", { href: scene.href }, make("span", {}, make("b", {}, scene.name), count), icon("next")),
  );
}
