// A `SplatSource` of Spark whose splats arrive over time: records stay as they were sent and are unpacked on the GPU,
// where terms give each splat the color that the eye sees.
import { dyno } from "@sparkjsdev/spark";
import { decodeRecord, tablesOf } from "gsvis-viewer";
import * as THREE from "three";
import { TEXEL_GLSL, Texels } from "./textures.js";

const GONE = 0xffffffff; // instead of a row: others have replaced this splat
const NAMES = ["records", "links", "chunks", "terms", "tables"];

/** What a source of gsvis sends, for `new SplatMesh({ splats })`. Call `mesh.updateVersion()` after `add`. */
export class GsvisSplats {
  constructor(header) {
    this.header = header;
    this.tables = tablesOf(header.colors);
    this.count = 0;
    this.texels = {
      records: new Texels(header.gaussians, 4),
      links: new Texels(header.gaussians, 2), // the row of the chunk, and the newest term from 1
      chunks: new Texels(2 * header.chunks, 4), // floats
      terms: new Texels(header.terms, 4), // two words, and the term before from 1
    };
    const parts = [...this.tables.base, this.tables.scales, this.tables.theta, this.tables.phi, this.tables.decays, this.tables.intensities];
    this.starts = parts.map((_, k) => parts.slice(0, k).reduce((sum, part) => sum + part.length, 0));
    this.texels.tables = new Texels(this.starts.at(-1) + parts.at(-1).length, 1);
    parts.forEach((part, k) => this.texels.tables.write(this.starts[k], new Uint32Array(part.buffer)));
    this.uniforms = NAMES.map((key) => new dyno.DynoUsampler2DArray({ key, value: this.texels[key].texture }));
  }

  /** Add a batch of the source. */
  add(batch) {
    const { records, links, chunks, terms } = this.texels, count = batch.ids.length;
    if (batch.chunks.length) chunks.write(2 * batch.firstRow, new Uint32Array(batch.chunks.buffer));
    if (count) {
      records.write(batch.first, batch.records);
      for (let i = 0; i < count; i++) links.data[2 * (batch.first + i)] = batch.rows[i];
      links.touch(batch.first, batch.first + count - 1);
    }
    const words = new Uint32Array(4 * batch.owners.length);
    batch.owners.forEach((slot, i) => {
      words.set([batch.terms[2 * i], batch.terms[2 * i + 1], links.data[2 * slot + 1]], 4 * i);
      links.data[2 * slot + 1] = batch.firstTerm + i + 1;
      links.touch(slot, slot);
    });
    if (words.length) terms.write(batch.firstTerm, words);
    for (const slot of batch.gone) {
      links.data[2 * slot] = GONE;
      links.touch(slot, slot);
    }
    this.count = Math.max(this.count, batch.first + count);
  }

  // What Spark asks of a source.

  prepareFetchSplat() {}

  getNumSplats() {
    return this.count;
  }

  /** Colors depend on the eye, as with spherical harmonics. */
  hasRgbDir() {
    return this.header.terms > 0;
  }

  getNumSh() {
    return 0;
  }

  setMaxSh() {}

  fetchSplat({ index, viewOrigin }) {
    const eye = viewOrigin ?? new dyno.DynoVec3({ value: new THREE.Vector3() });
    const types = Object.fromEntries(NAMES.map((name) => [name, "usampler2DArray"]));
    const read = new dyno.Dyno({
      inTypes: { index: "int", eye: "vec3", ...types },
      outTypes: { gsplat: dyno.Gsplat },
      inputs: { index, eye, ...Object.fromEntries(NAMES.map((name, k) => [name, this.uniforms[k]])) },
      globals: () => [dyno.defineGsplat, TEXEL_GLSL, this.glsl()],
      statements: ({ inputs, outputs }) => [
        `gsvisSplat(${NAMES.map((name) => inputs[name]).join(", ")}, ${inputs.index}, ${inputs.eye}, ${outputs.gsplat});`,
      ],
    });
    return new dyno.DynoOutput(read, "gsplat");
  }

  forEachSplat(callback) {
    const { records, links, chunks } = this.texels, floats = new Float32Array(chunks.data.buffer);
    for (let i = 0; i < this.count; i++) {
      const row = links.data[2 * i];
      if (row === GONE) continue;
      const s = decodeRecord(records.data, i, floats, row, this.tables), [w, x, y, z] = s.quat;
      const color = new THREE.Color(...s.base);
      callback(i, new THREE.Vector3(...s.mean), new THREE.Vector3(...s.scale), new THREE.Quaternion(x, y, z, w), s.opacity, color);
    }
  }

  dispose() {
    for (const texels of Object.values(this.texels)) texels.dispose();
  }

  /** Return the program that unpacks a record: docs/streaming.md, with the numbers of this scene. */
  glsl() {
    const { layout, widths, base, scales, intensities } = this.tables, hsl = layout.colorScale;
    const [toBase0, toBase1, toBase2, toScales, toTheta, toPhi, toDecays, toIntensities] = this.starts;
    const half = (1 << (layout.rotation - 1)) - 1, width = layout.position + layout.rotation + layout.scale;
    const bits = widths.map((_, k) => widths.slice(0, k).reduce((sum, bit) => sum + bit, 0));
    const field = (k) => `gsvisBits(t, ${bits[k]}, ${widths[k]})`;
    const intensity = (k) => `entry(${toIntensities} + min(${field(k)}, ${intensities.length - 1}))`;
    const place = (start, byte, table) => `entry(${start} + min(gsvisBits(r, ${8 * byte}, 8), ${table.length - 1}))`;
    return `
int gsvisBits(uvec4 r, int bit, int width) {
  int word = bit >> 5, shift = bit & 31;
  uint value = r[word] >> shift;
  if (shift + width > 32) value |= r[word + 1] << (32 - shift);
  return int(value & ((1u << width) - 1u));
}
float gsvisChannel(float shift, vec3 hsl) {
  float k = mod(shift + 12. * fract(hsl.x), 12.), chroma = hsl.y * min(hsl.z, 1. - hsl.z);
  return hsl.z - chroma * max(-1., min(min(k - 3., 9. - k), 1.));
}
#define entry(i) uintBitsToFloat(texelFetch(tables, gsvisTexel(i), 0).x)
void gsvisSplat(
  usampler2DArray records, usampler2DArray links, usampler2DArray chunks, usampler2DArray terms, usampler2DArray tables,
  int index, vec3 eye, out Gsplat g
) {
  g.flags = 0u;
  g.index = index;
  uvec2 link = texelFetch(links, gsvisTexel(index), 0).xy;
  uvec4 r = texelFetch(records, gsvisTexel(index), 0);
  if (link.x == ${GONE}u || (r.x & 255u) == 0u) return;
  vec4 origin = uintBitsToFloat(texelFetch(chunks, gsvisTexel(2 * int(link.x)), 0));
  vec4 step_ = uintBitsToFloat(texelFetch(chunks, gsvisTexel(2 * int(link.x) + 1), 0));
  vec3 place, turn, size;
  for (int k = 0; k < 3; k++) {
    int bit = ${layout.from} + k * ${width};
    place[k] = float(gsvisBits(r, bit, ${layout.position}));
    turn[k] = float(gsvisBits(r, bit + ${layout.position}, ${layout.rotation}) - ${half}) * ${Math.SQRT1_2 / half};
    size[k] = float(gsvisBits(r, bit + ${layout.position + layout.rotation}, ${layout.scale}));
  }
  g.flags = GSPLAT_FLAG_ACTIVE;
  g.center = origin.xyz + place * step_.xyz;
  g.scales = exp2(clamp(origin.w + size * step_.w, -8064., 8191.) / 64.);
  g.quaternion = normalize(vec4(turn, sqrt(max(0., 1. - dot(turn, turn)))));

  vec3 base = vec3(${place(toBase0, 1, base[0])}, ${place(toBase1, 2, base[1])}, ${place(toBase2, 3, base[2])});
  vec3 color = base, away = (origin.xyz - eye) + place * step_.xyz;
  float far = length(away);
  vec3 x = far > 0. ? away / far : vec3(0., 0., 1.);
  uint next = link.y;
  for (int n = 0; next != 0u && n < 255; n++) {
    uvec4 t = texelFetch(terms, gsvisTexel(int(next) - 1), 0);
    next = t.z;
    float theta = entry(${toTheta} + ${field(1)}), phi = entry(${toPhi} + ${field(2)});
    vec3 center = vec3(sin(theta) * cos(phi), sin(theta) * sin(phi), cos(theta));
    float lobe = exp(entry(${toDecays} + ${field(3)}) * (dot(x, center) - 1.));
    ${hsl
      ? `if ((t.x & 1u) == 0u) color.y += lobe * base.y * ${intensity(4)};\n    else color.z += lobe * base.z * ${intensity(4)};`
      : `color += lobe * vec3(${intensity(4)}, ${intensity(5)}, ${intensity(6)});`}
  }
  ${hsl
    ? `color = vec3(color.x, clamp(color.yz, 0., 1.));
  color = vec3(gsvisChannel(0., color), gsvisChannel(8., color), gsvisChannel(4., color)) * ${place(toScales, 4, scales)};`
    : ""}
  g.rgba = vec4(max(color, 0.), float(r.x & 255u) / 255.);
}
#undef entry`;
  }
}
