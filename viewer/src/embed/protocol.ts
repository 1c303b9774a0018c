// The messages between a page of a scene in a frame and the page around it; docs/how-to/embed.md lists them.

/** What a page is asked: by its parent alone, and answered with the same `id`. */
export interface Ask {
  gsvis: "ask";
  id: number;
  name: string;
  args: unknown[];
}

/** The answer to an `Ask`: a value, or what was wrong. */
export interface Answer {
  gsvis: "answer";
  id: number;
  value?: unknown;
  error?: string;
}

/** What happens in a page. `here` says that it listens; every other one follows the question `listen`. */
export interface PageEvent {
  gsvis: "event";
  name: "here" | "ready" | "progress" | "pose" | "pick" | "hotspot" | "animation" | "error";
  detail: unknown;
}

/** Return what came as a message of one kind, null for anything else. */
export function messageOf<T extends { gsvis: string }>(data: unknown, kind: T["gsvis"]): T | null {
  return typeof data === "object" && data !== null && (data as T).gsvis === kind ? (data as T) : null;
}
