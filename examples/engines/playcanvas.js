// A streamed SOG in PlayCanvas' engine: only the leaves that the cell of the camera needs are loaded and drawn.
// ?scene=FOLDER/&eye=x,y,z&target=x,y,z; &plain=1 leaves the choice to the engine, without the sidecar.
import * as pc from "playcanvas";
import { runScene } from "./page.js";

const canvas = document.querySelector("canvas"), asked = new URLSearchParams(location.search);
const app = new pc.Application(canvas, { graphicsDeviceOptions: { antialias: false, alpha: false } });
app.setCanvasFillMode(pc.FILLMODE_FILL_WINDOW);
app.setCanvasResolution(pc.RESOLUTION_AUTO);
addEventListener("resize", () => app.resizeCanvas());
const camera = new pc.Entity("camera");
camera.addComponent("camera", { clearColor: new pc.Color(0, 0, 0), fov: 60, nearClip: 0.02, farClip: 1000 });
app.root.addChild(camera);
app.start();

const player = {
  load: (url) => new Promise((resolve, reject) => {
    const asset = new pc.Asset(url, "gsplat", { url });
    asset.once("load", () => {
      const entity = new pc.Entity(url);
      entity.addComponent("gsplat", { asset });
      entity.enabled = false;
      app.root.addChild(entity);
      resolve({ asset, entity });
    });
    asset.once("error", reject);
    app.assets.add(asset);
    app.assets.load(asset);
  }),
  show: ({ entity }, yes) => { entity.enabled = yes; },
  free: ({ asset, entity }) => {
    entity.destroy();
    app.assets.remove(asset);
    asset.unload();
  },
};

if (asked.has("plain")) {
  const { NeededLeaves } = await import("./needed-leaves.js");
  const { Walk } = await import("./walk.js");
  const folder = asked.get("scene") ?? "scene/", walk = new Walk(canvas, (await NeededLeaves.open(folder)).header);
  follow(walk, (seconds) => walk.step(seconds));
  player.show(await player.load(`${folder}lod-meta.json`), true);
} else {
  const { walk, frame } = await runScene(canvas, player);
  follow(walk, frame);
}
globalThis.app = app;

/** Puts the camera where the walk is, every frame. */
function follow(walk, frame) {
  const vector = (values) => new pc.Vec3(...values);
  app.on("update", (seconds) => {
    const target = frame(seconds);
    camera.setPosition(vector(walk.position));
    camera.lookAt(vector(target), vector(walk.up));
  });
}
