// What has happened, in words for people.

import type { SourceState } from "../core/types.ts";
import { formatCount } from "./format.ts";

export interface Message {
  title: string;
  text: string;
  detail?: string; // what a program said
  retry?: boolean;
  token?: boolean;
}

export const NO_WEBGL: Message = {
  title: "This browser cannot draw the scene",
  text: "It offers no WebGL2. Switch that on, or use another browser.",
};

export const NO_SCENE: Message = {
  title: "No scene is named",
  text: "Open one from the list.",
};

export const REFUSED_SCENE: Message = {
  title: "This page may not open that scene",
  text: "It lies on another server. Whoever serves this page can name that one.",
};

export const NO_ANSWER: Message = {
  title: "No answer from the scene's server",
  text: "It is down, or does not let this page read the scene. The page keeps trying.",
};

export const LOST_CONTEXT = "The graphics card has taken the picture back. It is drawn again as soon as it returns.";
export const BAD_HASH = "The view in the address could not be read. You are at the first view.";
export const NOTHING = "Nothing of the scene can be seen from here. Key R leads to the first view.";
export const NOT_SERVED = "Only a server knows where a Gaussian is seen from.";
export const NO_WALLS = "Nothing is known of walls here. You walk freely.";
export const FAR_HASH = "The view in the address lies outside of the scene. You are at the first view.";

/** Return what to say when a source has given up. */
export function explainFailure(message: string, code?: number): Message {
  const detail = message.slice(0, 1000);
  if (code === 4) {
    return {
      title: "The server did not let this page in",
      text: "If it needs a token, enter it.", detail, token: true,
    };
  }
  const known: Record<number, [string, string]> = {
    1: [
      "The server refused a message",
      "Viewer and server do not understand each other. Load the page again.",
    ],
    2: [
      "Viewer and server differ in version",
      "Load the page again without the cache.",
    ],
    3: ["The server has ended the connection", "A limit was exceeded."],
    5: ["The server is full", "Try again soon."],
    6: ["The server has ended the connection", "A limit was exceeded."],
    7: ["The connection was too slow", "It waited too long."],
    8: ["The server has a problem", "It reported an error."],
    9: ["The server has shut down", "Try again later."],
  };
  const [title, text] = known[code ?? 0] ??
    ["The scene cannot be loaded", "Its server may be down."];
  return { title, text, detail, retry: true };
}

/** Return the line of the state, with a count unless that is null, that stands below the scene's name. */
export function describeState(state: SourceState, gaussians: number | null): string {
  switch (state.kind) {
    case "connecting": return "Connecting …";
    case "streaming": return gaussians ? `Loading · ${formatCount(gaussians)}` : "Loading …";
    case "complete": return gaussians === null ? "" : `${formatCount(gaussians)} Gaussians`;
    case "waiting":
      return state.seconds >= 1 ? `Retrying in ${Math.ceil(state.seconds)} s` : "Retrying …";
    case "failed": return "Stopped";
  }
}
