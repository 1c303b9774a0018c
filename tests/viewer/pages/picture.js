// A page that draws recorded batches, driven by tests/viewer/test_picture.py and benchmarks.
import { Viewer } from "./gsvis-viewer.js";

const canvas = document.getElementById("canvas");
let viewer = null, source = null;

class RecordedSource {
  constructor(scene, data) {
    this.scene = scene;
    this.data = data;
    this.poses = [];
    this.views = [];
    this.closed = false;
  }
  start(events) {
    this.events = events;
    events.header(this.scene.header, true);
  }
  pose(pose) { this.poses.push(pose); }
  view(view) { this.views.push(view); }
  close() { this.closed = true; }
  send(index) {
    const batch = {};
    for (const [name, part] of Object.entries(this.scene.batches[index])) {
      if (!Array.isArray(part)) { batch[name] = part; continue; }
      const [kind, offset, length] = part, type = globalThis[kind];
      batch[name] = new type(this.data.slice(offset, offset + length * type.BYTES_PER_ELEMENT));
    }
    const begin = performance.now();
    this.events.batch(batch);
    return performance.now() - begin;
  }
}

const toBase64 = (bytes) => {
  let text = "";
  for (let k = 0; k < bytes.length; k += 8192) text += String.fromCharCode(...bytes.subarray(k, k + 8192));
  return btoa(text);
};

window.test = {
  get viewer() { return viewer; },
  get source() { return source; },

  /** Open a scene; sends batches before `count`, all by default. Returns milliseconds of each. */
  async open(folder, options = {}, count = Infinity) {
    const [scene, data] = await Promise.all([
      fetch(`${folder}/scene.json`).then((answer) => answer.json()),
      fetch(`${folder}/scene.bin`).then((answer) => answer.arrayBuffer()),
    ]);
    viewer?.dispose();
    source = new RecordedSource(scene, data);
    viewer = new Viewer(canvas, { ...options, source });
    window.problems = [];
    viewer.addEventListener("problem", (event) => window.problems.push(event.detail));
    if (scene.sets) source.events.sets(0, Uint8Array.from(atob(scene.sets), (letter) => letter.charCodeAt(0)));
    return scene.batches.slice(0, count).map((_, k) => source.send(k));
  },

  /** Draw a camera on the canvas, and return the canvas's own bytes, RGBA rows from the bottom. */
  async canvasBytes(lens) {
    viewer.lens = lens;
    await viewer.settled();
    return new Promise((resolve) => {
      viewer.addEventListener("frame", () => {
        const gl = canvas.getContext("webgl2"), bytes = new Uint8Array(4 * lens.width * lens.height);
        gl.bindFramebuffer(gl.FRAMEBUFFER, null);
        gl.readPixels(0, 0, lens.width, lens.height, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
        resolve(toBase64(bytes));
      }, { once: true });
      viewer.redraw();
    });
  },

  async capture(lens) {
    const image = await viewer.capture(lens);
    return toBase64(new Uint8Array(image.data.buffer));
  },

  /** Turn the canvas into nothing and back. */
  async loseContext() {
    const lose = canvas.getContext("webgl2").getExtension("WEBGL_lose_context");
    const lost = new Promise((resolve) => viewer.addEventListener("contextlost", resolve, { once: true }));
    lose.loseContext();
    await lost;
    return { restore: void (window.restore = () => lose.restoreContext()) };
  },

  async restoreContext() {
    const back = new Promise((resolve) => viewer.addEventListener("contextrestored", resolve, { once: true }));
    window.restore();
    await back;
  },

  /** Turn around for some seconds; frames a second. */
  async spin(lens, seconds) {
    const start = performance.now(), before = viewer.statistics.frames;
    const turn = (angle) => {
      const [w, x, y, z] = lens.rotation, c = Math.cos(angle / 2), s = Math.sin(angle / 2);
      return [w * c - y * s, x * c - z * s, w * s + y * c, z * c + x * s]; // around the camera's own y
    };
    while (performance.now() - start < 1000 * seconds) {
      viewer.lens = { ...lens, rotation: turn(0.3 * Math.sin((performance.now() - start) / 700)) };
      await new Promise(requestAnimationFrame);
    }
    const gl = canvas.getContext("webgl2");
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
    const spent = (performance.now() - start) / 1000;
    return { ...viewer.statistics, "frames shown": viewer.statistics.frames - before, fps: (viewer.statistics.frames - before) / spent };
  },
};
window.ready = true;
