// Starts the page: the list of scenes, or one scene.

import * as gsvis from "../core/index.ts";
import { readAddress } from "./address.ts";
import type { SceneAddress } from "./address.ts";
import { make, meta } from "./dom.ts";
import { showList } from "./list.ts";
import { NO_SCENE } from "./messages.ts";
import { Notices } from "./notice.ts";
import { locate } from "./scene.ts";
import { ThemeChoice } from "./theme.ts";
import { ViewPage } from "./view.ts";
import type { Core } from "./view.ts";

const LOOKS_MS = 3000; // between two questions whether the scene is prepared

if (document.querySelector("#scenes")) {
  void showList();
} else {
  const page = readAddress(location.href, { scene: meta("scene"), content: meta("content"), settings: meta("settings") });
  if (page.scene) {
    const core: Core = {
      makeViewer: (canvas, options) => new gsvis.Viewer(canvas, options),
      makeSource: (scene, token) => (scene.kind === "stream" ? gsvis.streamSource(scene.url, token ? { token } : {}) : gsvis.staticSource(scene.url)),
    };
    void locate(page.scene).then(({ scene, preparing }) => {
      const shown = new ViewPage(scene, page, core);
      if (preparing) void changeOver(scene, shown);
    });
  } else {
    const notices = new Notices({ retry: () => location.reload(), token: () => undefined });
    new ThemeChoice(() => undefined);
    document.querySelector("main")?.replaceChildren(notices.card, make("p"));
    notices.stop(NO_SCENE);
  }
}

/** Wait until the server has prepared the scene, then show it as a stream. */
async function changeOver(scene: SceneAddress, shown: ViewPage): Promise<void> {
  for (;;) {
    await new Promise((done) => setTimeout(done, LOOKS_MS));
    const now = await locate(scene);
    if (now.scene.kind === "stream") return shown.change(now.scene);
    if (!now.preparing) return;
  }
}
