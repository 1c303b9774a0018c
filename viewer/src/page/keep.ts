// What a visitor takes along: the link to a view, a picture; and what the browser allows.

import { make } from "./dom.ts";
import type { ViewerLike } from "./viewer-like.ts";
import { text } from "./words.ts";

type Say = (line: string) => void;

const KEPT_MS = 10_000; // until the memory of a picture that was saved is freed

/** Copy the address of the page, which holds the view. */
export async function copyLink(say: Say): Promise<void> {
  try {
    await navigator.clipboard.writeText(location.href);
    say(text("say.copied"));
  } catch {
    say(text("say.uncopied"));
  }
}

/** Let the browser save what a blob holds. */
export function saveAs(content: Blob, name: string): void {
  const url = URL.createObjectURL(content);
  make("a", { href: url, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(url), KEPT_MS);
}

/** Save the picture as PNG, named after the scene. */
export async function savePicture(viewer: ViewerLike | null, name: string, say: Say): Promise<void> {
  if (!viewer) return;
  try {
    saveAs(await viewer.screenshot(), `${name.replace(/[^\w.-]+/g, "_") || "scene"}.png`);
    say(text("say.saved"));
  } catch (error) {
    say(text("say.unsaved", { reason: reasonOf(error) }).trim());
  }
}

/** Fill the screen, or leave it. */
export async function toggleFull(say: Say): Promise<void> {
  try {
    if (document.fullscreenElement) await document.exitFullscreen();
    else await document.documentElement.requestFullscreen();
  } catch {
    say(text("say.full"));
  }
}

/** Return what an error says, "" for anything else. */
export function reasonOf(error: unknown): string {
  return error instanceof Error ? error.message : "";
}

/** Whether this browser draws with WebGL2. */
export function offersWebGL(): boolean {
  const context = make("canvas", { width: 1, height: 1 }).getContext("webgl2");
  context?.getExtension("WEBGL_lose_context")?.loseContext();
  return context !== null;
}
