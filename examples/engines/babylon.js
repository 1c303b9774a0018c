// A streamed SOG in Babylon.js: only the leaves that the cell of the camera needs are loaded and drawn.
// ?scene=FOLDER/&eye=x,y,z&target=x,y,z
// Babylon sorts each mesh of splats alone, and a compound mesh has at most 256 parts. So all that is shown goes into one mesh.
import { gatherShown, joined } from "./gathered.js";
import { runScene } from "./page.js";

const { BABYLON } = globalThis, canvas = document.querySelector("canvas");
BABYLON.Logger.LogLevels = BABYLON.Logger.WarningLogLevel | BABYLON.Logger.ErrorLogLevel;
const engine = new BABYLON.Engine(canvas, false), scene = new BABYLON.Scene(engine);
scene.useRightHandedSystem = true; // as the frame of the scene
scene.clearColor = new BABYLON.Color4(0, 0, 0, 1);
const camera = new BABYLON.FreeCamera("camera", BABYLON.Vector3.Zero(), scene);
Object.assign(camera, { fov: Math.PI / 3, minZ: 0.02, maxZ: 1000 });
const mesh = new BABYLON.GaussianSplattingMesh("scene", null, scene);

/** Reads a leaf with Babylon's loader: 32 bytes a splat, and the higher harmonics, 16 bytes a splat in each of some arrays. */
async function read(url) {
  const options = { pluginExtension: ".json", pluginOptions: { splat: { keepInRam: true } } };
  const found = await BABYLON.LoadAssetContainerAsync(url, scene, options), { splatsData, shData, shDegree } = found.meshes[0];
  const splats = new Uint8Array(splatsData.slice(0)), bytes = splats.length / 2;
  const leaf = { splats, degree: shDegree, harmonics: (shData ?? []).map((array) => array.slice(0, bytes)) };
  found.dispose();
  return leaf;
}

async function build(shown) {
  mesh.setEnabled(shown.length > 0);
  if (!shown.length) return;
  const degree = Math.max(...shown.map((leaf) => leaf.degree)), textures = Math.max(...shown.map(({ harmonics }) => harmonics.length));
  const zeros = ({ splats }) => new Uint8Array(splats.length / 2).fill(128);
  const harmonics = Array.from({ length: textures }, (_, k) => joined(shown.map((leaf) => leaf.harmonics[k] ?? zeros(leaf))));
  const splats = joined(shown.map((leaf) => leaf.splats));
  await mesh.updateDataAsync(splats.buffer, textures ? harmonics : undefined, undefined, degree);
}

const { walk, frame } = await runScene(canvas, gatherShown(read, build));
camera.upVector = new BABYLON.Vector3(...walk.up);
addEventListener("resize", () => engine.resize());
engine.resize();
engine.runRenderLoop(() => {
  const target = frame(engine.getDeltaTime() / 1000);
  camera.position.set(...walk.position);
  camera.setTarget(new BABYLON.Vector3(...target));
  scene.render();
});
