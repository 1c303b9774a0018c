// A streamed SOG in Spark (three.js): only the leaves that the cell of the camera needs are loaded and drawn.
// ?scene=FOLDER/&eye=x,y,z&target=x,y,z
import { SparkRenderer, SplatFileType, SplatMesh } from "@sparkjsdev/spark";
import * as THREE from "three";
import { zipSync } from "three/addons/libs/fflate.module.js";
import { runScene } from "./page.js";

const canvas = document.querySelector("canvas");
const renderer = new THREE.WebGLRenderer({ canvas, antialias: false });
const scene = new THREE.Scene(), camera = new THREE.PerspectiveCamera(60, 1, 0.02, 1000);
scene.add(new SparkRenderer({ renderer }));

/** Returns the files of a SOG folder as one zip: Spark reads SOG in that form alone. */
async function bundle(url) {
  const get = async (address) => {
    const answer = await fetch(address);
    if (!answer.ok) throw new Error(`${address}: HTTP ${answer.status}`);
    return new Uint8Array(await answer.arrayBuffer());
  };
  const text = await get(url), meta = JSON.parse(new TextDecoder().decode(text));
  const names = ["means", "quats", "scales", "sh0", "shN"].flatMap((part) => meta[part]?.files ?? []);
  const files = await Promise.all(names.map((name) => get(new URL(name, new URL(url, location.href)))));
  return zipSync({ "meta.json": text, ...Object.fromEntries(names.map((name, k) => [name, files[k]])) }, { level: 0 });
}

const player = {
  load: async (url) => {
    const mesh = new SplatMesh({ fileBytes: await bundle(url), fileType: SplatFileType.PCSOGSZIP });
    await mesh.initialized;
    mesh.visible = false;
    scene.add(mesh);
    return mesh;
  },
  show: (mesh, yes) => { mesh.visible = yes; },
  free: (mesh) => {
    scene.remove(mesh);
    mesh.dispose();
  },
};

const { walk, frame } = await runScene(canvas, player);
camera.up.set(...walk.up);
let before = performance.now();
renderer.setAnimationLoop((now) => {
  const target = frame((now - before) / 1000);
  before = now;
  if (canvas.width !== innerWidth || canvas.height !== innerHeight) {
    renderer.setSize(innerWidth, innerHeight, false);
    camera.aspect = innerWidth / innerHeight;
    camera.updateProjectionMatrix();
  }
  camera.position.set(...walk.position);
  camera.lookAt(...target);
  renderer.render(scene, camera);
});
