// A streamed SOG in three.js alone: only the leaves that the cell of the camera needs are loaded and drawn.
// ?scene=FOLDER/&eye=x,y,z&target=x,y,z
// All that is shown is one mesh of quads. A texture holds the splats, and a Worker sorts them.
import * as THREE from "three";
import { gatherShown, joined } from "./gathered.js";
import { HARMONICS, joinHarmonics } from "./harmonics.js";
import { runScene } from "./page.js";
import { readSog } from "./sog.js";

const WIDTH = 2048; // texels of a row: 1,024 splats
const VERTEX = `
  in uint order;
  uniform highp usampler2D splats;
  uniform vec2 size;
  uniform bool curved; // colors change with the direction; those of the splats are the numbers of their leaves
  ${HARMONICS}
  out vec4 tint;
  out vec2 place;
  vec4 bytesOf(uint word) { return vec4(uvec4(word, word >> 8, word >> 16, word >> 24) & 255u) / 255.0; }
  void main() {
    ivec2 at = ivec2(2 * int(order % ${WIDTH / 2}u), int(order / ${WIDTH / 2}u));
    uvec4 first = texelFetch(splats, at, 0), second = texelFetch(splats, at + ivec2(1, 0), 0);
    vec3 center = (modelViewMatrix * vec4(uintBitsToFloat(first.xyz), 1.0)).xyz;
    tint = bytesOf(second.z);
    gl_Position = vec4(0.0, 0.0, 2.0, 1.0);
    if (center.z > -0.02 || tint.a < 1.0 / 255.0) return;
    if (curved) tint.rgb = colorOf(int(order), int(second.z & 0xffffffu), normalize(uintBitsToFloat(first.xyz) - cameraPosition));
    vec4 q = normalize(bytesOf(second.w) * 2.0 - 1.0); // w x y z
    vec3 v = q.yzw;
    mat3 k = mat3(0.0, v.z, -v.y, -v.z, 0.0, v.x, v.y, -v.x, 0.0);
    mat3 turn = mat3(1.0) + 2.0 * (q.x * k + k * k);
    vec3 deviations = vec3(uintBitsToFloat(first.w), uintBitsToFloat(second.xy));
    mat3 axes = mat3(modelViewMatrix) * turn * mat3(deviations.x, 0.0, 0.0, 0.0, deviations.y, 0.0, 0.0, 0.0, deviations.z);
    vec2 focal = 0.5 * size * vec2(projectionMatrix[0][0], projectionMatrix[1][1]);
    vec2 slope = clamp(center.xy / -center.z, -1.3 * size / focal * 0.5, 1.3 * size / focal * 0.5);
    mat3 toPixels = mat3(focal.x, 0.0, 0.0, 0.0, focal.y, 0.0, focal * slope, 0.0); // times 1 / -z
    mat3 onto = toPixels * axes;
    mat3 spread = onto * transpose(onto);
    float scale = 1.0 / (center.z * center.z);
    float xx = scale * spread[0][0] + 0.3, yy = scale * spread[1][1] + 0.3, xy = scale * spread[0][1];
    float middle = 0.5 * (xx + yy), apart = length(vec2(0.5 * (xx - yy), xy));
    vec2 along = apart < 1e-9 ? vec2(1.0, 0.0) : normalize(abs(xy) > 1e-9 ? vec2(xy, middle + apart - xx) : (xx > yy ? vec2(1.0, 0.0) : vec2(0.0, 1.0)));
    float reach = sqrt(2.0 * log(255.0 * tint.a));
    place = position.xy * reach;
    vec2 pixels = place.x * sqrt(middle + apart) * along + place.y * sqrt(max(middle - apart, 0.1)) * vec2(-along.y, along.x);
    vec4 clip = projectionMatrix * vec4(center, 1.0);
    gl_Position = vec4(clip.xy + pixels * 2.0 / size * clip.w, clip.zw);
  }`;
const FRAGMENT = `
  in vec4 tint;
  in vec2 place;
  out vec4 color;
  void main() {
    float alpha = tint.a * exp(-0.5 * dot(place, place));
    if (alpha < 1.0 / 255.0) discard;
    color = vec4(tint.rgb * alpha, alpha);
  }`;

const canvas = document.querySelector("canvas"), renderer = new THREE.WebGLRenderer({ canvas, antialias: false });
renderer.outputColorSpace = THREE.LinearSRGBColorSpace; // colors of splats are those of the screen
const scene = new THREE.Scene(), camera = new THREE.PerspectiveCamera(60, 1, 0.02, 1000);
const size = new THREE.Vector2(1, 1), geometry = new THREE.InstancedBufferGeometry();
geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array([-1, -1, 0, 1, -1, 0, 1, 1, 0, -1, 1, 0]), 3));
geometry.setIndex([0, 1, 2, 0, 2, 3]);
geometry.instanceCount = 0;
const material = new THREE.ShaderMaterial({
  vertexShader: VERTEX, fragmentShader: FRAGMENT, glslVersion: THREE.GLSL3, transparent: true, depthTest: false, depthWrite: false,
  blending: THREE.CustomBlending, blendSrc: THREE.OneFactor, blendDst: THREE.OneMinusSrcAlphaFactor,
  uniforms: { splats: { value: null }, sets: { value: null }, levels: { value: null }, curved: { value: false }, size: { value: size } },
});
const mesh = new THREE.Mesh(geometry, material);
mesh.frustumCulled = false;
scene.add(mesh);

const textureOf = (data, width, rows, format, type, internalFormat) => {
  const texture = new THREE.DataTexture(data, width, rows, format, type);
  return Object.assign(texture, { internalFormat, needsUpdate: true });
};
const ofIntegers = (data, width, rows) => textureOf(data, width, rows, THREE.RGBAIntegerFormat, THREE.UnsignedIntType, "RGBA32UI");

/** Positions and textures of what is shown. It is drawn when its first order comes. */
const worker = new Worker(new URL("sort-worker.js", import.meta.url));
let newest = 0, waiting = null, sorting = false, sorted = null;
function build(shown) {
  const harmonics = joinHarmonics(shown), splats = joined(shown.map(({ splats }, leaf) => (harmonics ? numbered(splats, leaf) : splats)));
  const count = splats.length / 32, rows = Math.max(Math.ceil((2 * count) / WIDTH), 1);
  const texels = new Uint32Array(4 * WIDTH * rows), floats = new Float32Array(splats.buffer), positions = new Float32Array(3 * count);
  texels.set(new Uint32Array(splats.buffer));
  for (let k = 0; k < count; k++) positions.set(floats.subarray(8 * k, 8 * k + 3), 3 * k);
  const { sets, levels, width, levelsWidth } = harmonics ?? { sets: new Uint32Array(4), levels: new Float32Array(1), width: 1, levelsWidth: 1 };
  for (const texture of waiting?.textures ?? []) texture.dispose();
  waiting = {
    build: ++newest, curved: harmonics !== null,
    textures: [ofIntegers(texels, WIDTH, rows), ofIntegers(sets, width, sets.length / 4 / width),
      textureOf(levels, levelsWidth, levels.length / levelsWidth, THREE.RedFormat, THREE.FloatType, "R32F")],
  };
  worker.postMessage({ positions, build: newest }, [positions.buffer]);
  sorted = null;
}

/** Returns splats whose color is the number of their leaf. */
function numbered(splats, leaf) {
  const copy = splats.slice(), words = new Uint32Array(copy.buffer);
  for (let at = 6; at < words.length; at += 8) words[at] = (words[at] & 0xff000000) | leaf;
  return copy;
}
worker.onmessage = ({ data: { order, build } }) => {
  sorting = false;
  if (build !== newest) return;
  if (waiting) {
    ["splats", "sets", "levels"].forEach((name, k) => {
      material.uniforms[name].value?.dispose();
      material.uniforms[name].value = waiting.textures[k];
    });
    material.uniforms.curved.value = waiting.curved;
    waiting = null;
  }
  if (geometry.getAttribute("order")?.count !== order.length) {
    geometry.dispose();
    geometry.setAttribute("order", new THREE.InstancedBufferAttribute(order, 1));
  } else {
    geometry.getAttribute("order").array.set(order);
    geometry.getAttribute("order").needsUpdate = true;
  }
  geometry.instanceCount = order.length;
};

const { walk, frame } = await runScene(canvas, gatherShown(readSog, build));
camera.up.set(...walk.up);
let before = performance.now();
renderer.setAnimationLoop((now) => {
  const target = frame((now - before) / 1000);
  before = now;
  if (canvas.width !== innerWidth || canvas.height !== innerHeight) {
    renderer.setSize(innerWidth, innerHeight, false);
    size.set(innerWidth, innerHeight);
    camera.aspect = innerWidth / innerHeight;
    camera.updateProjectionMatrix();
  }
  camera.position.set(...walk.position);
  camera.lookAt(...target);
  if (!sorting && newest && (!sorted || walk.forward.some((f, k) => Math.abs(f - sorted[k]) > 0.01))) {
    sorted = [...walk.forward];
    sorting = true;
    worker.postMessage({ forward: walk.forward });
  }
  renderer.render(scene, camera);
});
