// What has happened, in words for people.

import type { SourceState } from "../core/types.ts";
import { formatCount, formatGaussians } from "./format.ts";
import { text } from "./words.ts";

export interface Message {
  title: string;
  text: string;
  detail?: string; // what a program said
  retry?: boolean;
  token?: boolean;
}

const CODES = [1, 2, 3, 4, 5, 7, 8, 9] as const; // of a server that ends a connection

type Name = "webgl" | "scene" | "refused" | "silent" | "failed" | (typeof CODES)[number];

/** Return the message with a name. */
export function messageOf(name: Name): Message {
  return { title: text(`stop.${name}`), text: text(`stop.${name}.text`) };
}

/** Return what to say when a source has given up. */
export function explainFailure(said: string, code?: number): Message {
  const detail = said.slice(0, 1000), known = code === 6 ? 3 : CODES.find((each) => each === code);
  const message = { ...messageOf(known ?? "failed"), detail };
  return code === 4 ? { ...message, token: true } : { ...message, retry: true };
}

/** Return the line of the state, with a count unless that is null, that stands below the scene's name. */
export function describeState(state: SourceState, gaussians: number | null): string {
  switch (state.kind) {
    case "connecting": return text("state.connecting");
    case "streaming":
      return gaussians ? text("state.streaming.count", { count: formatCount(gaussians) }) : text("state.streaming");
    case "complete": return gaussians === null ? "" : formatGaussians(gaussians);
    case "waiting":
      return state.seconds >= 1 ? text("state.waiting.seconds", { seconds: Math.ceil(state.seconds) })
        : text("state.waiting");
    case "failed": return text("state.failed");
  }
}
