// A scene of gsvis among objects of three.js: streams as the camera moves.
// ?stream=ws://HOST/stream/NAME&token=TOKEN&eye=x,y,z&target=x,y,z (scene units)
import { SparkControls, SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
import { streamSource } from "gsvis-viewer";
import * as THREE from "three";
import { GsvisSplats } from "./gsvis-splats.js";

const asked = new URLSearchParams(location.search);
const triple = (name) => asked.get(name)?.split(",").map(Number);

const renderer = new THREE.WebGLRenderer({ antialias: false });
document.body.append(renderer.domElement);
const scene = new THREE.Scene();
const camera = new THREE.PerspectiveCamera(60, 1, 0.05, 1000);
// As the splats were trained: 0.3 pixels of blur without correction, 1/255 the least alpha, order by depth, colors above 1 kept.
const asTrained = { preBlurAmount: 0.3, blurAmount: 0, maxStdDev: 3.33, minAlpha: 1 / 255, sortRadial: false, accumExtSplats: true };
scene.add(new SparkRenderer({ renderer, ...asTrained }));
const controls = new SparkControls({ canvas: renderer.domElement });

const frame = new THREE.Group(); // turns the scene's up axis to that of three.js
scene.add(frame);
let splats = null, mesh = null, hasEye = false;
const line = document.querySelector("p");

/** Put the camera at a point of the scene. */
function stand(eye, target) {
  frame.updateMatrixWorld();
  camera.position.copy(frame.localToWorld(new THREE.Vector3(...eye)));
  camera.lookAt(frame.localToWorld(new THREE.Vector3(...target)));
  hasEye = true;
}

const options = asked.has("token") ? { token: asked.get("token") } : {};
const source = streamSource(asked.get("stream") ?? "ws://127.0.0.1:8765/stream", options);
source.start({
  header(header, fresh) {
    if (!fresh) return;
    mesh?.removeFromParent();
    splats?.dispose();
    splats = new GsvisSplats(header);
    mesh = new SplatMesh({ splats });
    frame.quaternion.setFromUnitVectors(new THREE.Vector3(...header.up), new THREE.Vector3(0, 1, 0));
    frame.add(mesh);
    if (asked.has("eye")) stand(triple("eye"), triple("target") ?? [0, 0, 0]);
  },
  batch(batch) {
    splats.add(batch);
    mesh.updateVersion();
    if (!hasEye && batch.ids.length) stand(middle(batch.means), batch.means.slice(0, 3));
  },
  state(state) {
    const words = { connecting: "Connecting …", streaming: "Streaming …", complete: "" };
    line.textContent = state.kind in words ? words[state.kind] : state.message;
  },
  traffic() {},
});

/** Return the mean of points. */
function middle(points) {
  const sum = [0, 0, 0];
  points.forEach((value, k) => { sum[k % 3] += (3 * value) / points.length; });
  return sum;
}

function resize() {
  renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
  renderer.setSize(innerWidth, innerHeight);
  camera.aspect = innerWidth / innerHeight;
  camera.updateProjectionMatrix();
  const up = Math.tan((camera.fov / 2) * (Math.PI / 180)), side = up * camera.aspect;
  source.view({ left: side, right: side, up, down: up });
}
addEventListener("resize", resize);
resize();

const toOpenCv = new THREE.Matrix4().makeScale(1, -1, -1), place = new THREE.Vector3(), turn = new THREE.Quaternion(), ones = new THREE.Vector3();
renderer.setAnimationLoop(() => {
  if (hasEye) controls.update(camera);
  camera.updateMatrixWorld();
  frame.updateMatrixWorld();
  frame.matrixWorld.clone().invert().multiply(camera.matrixWorld).multiply(toOpenCv).decompose(place, turn, ones);
  source.pose({ position: place.toArray(), rotation: [turn.w, turn.x, turn.y, turn.z] });
  renderer.render(scene, camera);
});
