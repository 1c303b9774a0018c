// Asks the server what a scene is, and static scenes for the views that they propose.

import type { Pose, Source } from "../core/types.ts";
import type { SceneAddress } from "./address.ts";
import { readPoses } from "./facts.ts";
import type { StartPose } from "./facts.ts";

/** Where a scene is read from, and whether its server prepares it for streaming meanwhile. */
export interface Located {
  scene: SceneAddress;
  preparing: boolean;
}

/** Return the address to read a scene from: a server has some scenes as streams and some as files. */
export async function locate(scene: SceneAddress): Promise<Located> {
  if (!scene.root) return { scene, preparing: false };
  const listed = await ask(scene.root);
  const rows = isFields(listed) && Array.isArray(listed.scenes) ? listed.scenes.filter(isFields) : [];
  const row = rows.find((each) => each.name === scene.name);
  if (typeof row?.stream === "string") return { scene: { ...scene, kind: "stream", url: streamUrl(row.stream, scene.root) }, preparing: false };
  if (typeof row?.static !== "string") return { scene, preparing: false };
  return { scene: { ...scene, kind: "static", url: new URL(row.static, scene.root).href }, preparing: row.preparing === true };
}

function streamUrl(path: string, root: string): string {
  const url = new URL(path, root);
  url.protocol = url.protocol === "https:" ? "wss:" : "ws:";
  return url.href;
}

/** Return the views that a static scene proposes; none for a stream. */
export async function proposedPoses(scene: SceneAddress): Promise<StartPose[]> {
  if (scene.kind !== "static") return [];
  const address = /\.json$/.test(new URL(scene.url).pathname) ? scene.url : `${scene.url.replace(/\/?$/, "/")}scene.json`;
  const content = scene.url === "inline:" ? readInline() : await ask(address);
  return isFields(content) ? readPoses(content.poses) : [];
}

/** Hold poses back until the page has chosen its first view: no byte is spent on a view that nobody sees. */
export function holdPoses(source: Source): { source: Source; release(): void } {
  let [held, open]: [Pose | null, boolean] = [null, false];
  return {
    source: {
      start: (events) => source.start(events),
      view: (view) => source.view(view),
      close: () => source.close(),
      pose: (pose) => {
        held = pose;
        if (open) source.pose(pose);
      },
    },
    release: () => {
      if (!open && held) source.pose(held);
      open = true;
    },
  };
}

function readInline(): unknown {
  try {
    return JSON.parse(atob(document.querySelector('script[data-name="scene.json"]')?.textContent?.trim() ?? ""));
  } catch {
    return null;
  }
}

async function ask(address: string): Promise<unknown> {
  try {
    const response = await fetch(address, { headers: { accept: "application/json" } });
    return response.ok ? await response.json() : null;
  } catch {
    return null; // the source says what is wrong
  }
}

function isFields(value: unknown): value is Record<string, unknown> {
  return typeof value === "object" && value !== null && !Array.isArray(value);
}
