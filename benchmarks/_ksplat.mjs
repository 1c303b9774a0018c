// What GaussianSplats3D reads in a .ksplat, as floats, and what it writes of a PLY.
//   node _ksplat.mjs NODE_MODULES read IN.ksplat OUT.f32
//   node _ksplat.mjs NODE_MODULES write IN.ply OUT.ksplat LEVEL
import { readFileSync, writeFileSync } from "node:fs";
import { createRequire } from "node:module";
import { pathToFileURL } from "node:url";

const [modules, way, given, made, level] = process.argv.slice(2);
const find = createRequire(`${modules}/`);
globalThis.window = globalThis.self = globalThis;
const folder = `${modules}/@mkkellogg/gaussian-splats-3d/build/gaussian-splats-3d.module.js`;
const peer = await import(pathToFileURL(folder).href);
const three = await import(pathToFileURL(find.resolve("three").replace("three.cjs", "three.module.js")).href);
const file = readFileSync(given);
const data = file.buffer.slice(file.byteOffset, file.byteOffset + file.byteLength);

if (way === "write") {
  const splats = peer.PlyParser.parseToUncompressedSplatArray(data, 2);
  const maker = peer.SplatBufferGenerator.getStandardGenerator(0, Number(level), 16384, new three.Vector3());
  writeFileSync(made, Buffer.from(maker.generateFromUncompressedSplatArray(splats).bufferData));
} else {
  const splats = await peer.KSplatLoader.loadFromFileData(data);
  const count = splats.getSplatCount(), degree = splats.getMinSphericalHarmonicsDegree(), size = [0, 9, 24][degree];
  const low = splats.minSphericalHarmonicsCoeff, high = splats.maxSphericalHarmonicsCoeff;
  let higher = new Float32Array(count * size);
  if (size && splats.compressionLevel === 2) {
    const bytes = new Uint8Array(count * size);
    splats.fillSphericalHarmonicsArray(bytes, degree, undefined, 0, count - 1, 0, 2);
    higher = Float32Array.from(bytes, (byte) => (byte / 255) * (high - low) + low); // as its shader does
  } else if (size) splats.fillSphericalHarmonicsArray(higher, degree, undefined, 0, count - 1, 0, 0);
  const out = new Float32Array(count * (14 + size));
  const center = new three.Vector3(), scale = new three.Vector3(), turn = new three.Quaternion();
  const color = new three.Vector4();
  for (let i = 0; i < count; i++) {
    splats.getSplatCenter(i, center);
    splats.getSplatScaleAndRotation(i, scale, turn);
    splats.getSplatColor(i, color);
    out.set([...center, ...scale, turn.w, turn.x, turn.y, turn.z, ...color], i * (14 + size));
    out.set(higher.subarray(i * size, (i + 1) * size), i * (14 + size) + 14);
  }
  writeFileSync(made, out);
}
