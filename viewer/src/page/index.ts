// Starts the page of one scene.

import * as gsvis from "../core/index.ts";
import { permitOf, readAddress } from "./address.ts";
import { make, meta } from "./dom.ts";
import { messageOf } from "./messages.ts";
import { Notices } from "./notice.ts";
import { awaitMore, locate } from "./scene.ts";
import { part } from "./parts.ts";
import { ThemeChoice } from "./theme.ts";
import { ViewPage } from "./view.ts";
import type { Core } from "./view.ts";
import { speakLanguage } from "./words.ts";

type Early = { gsvisEarly?: { base: string; worker: Worker } | null };

/** Return the Worker that the page of a site begins before this script is here; the first source of its scene has it. */
function takeEarly(url: string): gsvis.StaticOptions {
  const held = globalThis as Early, early = held.gsvisEarly;
  held.gsvisEarly = null;
  if (!early) return {};
  if (early.base === url) return { worker: () => early.worker };
  early.worker.terminate();
  return {};
}

await speakLanguage();
const origins = meta("origins"), permits = permitOf(location.href, origins), isOwn = permitOf(location.href);
const page = readAddress(
  location.href, { scene: meta("scene"), content: meta("content"), settings: meta("settings"), visitor: meta("visitor"), origins },
);
if (page.scene) {
  const room = gsvis.memoryOfDevice(); // a large one never fills
  const memory = room < 1e9 ? 0.6 * room * (16 / 68) : 0; // gaps of what was evicted, and bytes on the GPU
  const core: Core = {
    makeViewer: (canvas, options) => new gsvis.Viewer(canvas, options),
    makeSource: (scene, token) => (scene.kind === "stream" ? gsvis.streamSource(
      scene.url, token && isOwn(scene.url) ? { token, memory } : { memory }, // no other origin learns the token
    ) : gsvis.staticSource(scene.url, takeEarly(scene.url))),
  };
  const { scene } = page, known = meta("streamed") && scene.kind === "stream"; // then there is nothing to ask
  const located = known ? Promise.resolve({ scene, preparing: false, gaussians: null }) : locate(scene, permits);
  void located.then(({ scene, preparing, gaussians }) => {
    const shown = new ViewPage(scene, page, core);
    if (parent !== window) void part("embed").then((embed) => embed(shown.stage, (meta("embedders") ?? "").split(" ")));
    if (preparing) void awaitMore(scene, permits, gaussians).then((more) => more && shown.change(more));
  });
} else {
  const notices = new Notices({ retry: () => location.reload(), token: () => undefined });
  new ThemeChoice(() => undefined);
  document.querySelector("main")?.replaceChildren(notices.card, make("p"));
  notices.stop(/[?&]content=/.test(location.search) ? messageOf("refused") : messageOf("scene"));
}
