// The programs of the GPU. `colors` finds what the eye sees of each Gaussian, `project` its ellipse in the picture,
// `splat` blends the ellipses back to front, `present` brings the picture to the canvas.
// Thresholds: docs/conventions.md.

/** Quads of one instance. Software renderers pay for each instance. */
export const QUADS = 1024;

const HEAD = `#version 300 es
precision highp float; precision highp int; precision highp usampler2D; precision highp sampler2D;
const int ROW = 2048;
ivec2 texel(uint i) { return ivec2(int(i & 2047u), int(i >> 11)); }
`;

/** Draws one triangle over everything. */
export const cover = `#version 300 es
void main() { gl_Position = vec4(gl_VertexID == 1 ? 3. : -1., gl_VertexID == 2 ? 3. : -1., 0., 1.); }`;

// Fields of a record for x, y, z: p place in the chunk's box, q component of the quaternion, s log-scale.
const UNPACK_RGB = `
const float HALF = 255.;
uvec3 places(uvec4 r) { return r.yzw & 16383u; }
uvec3 turns(uvec4 r) { return (r.yzw >> 14) & 511u; }
uvec3 sizes(uvec4 r) { return r.yzw >> 23; }
`;
const UNPACK_HSL = `
const float HALF = 127.;
uvec3 places(uvec4 r) { return uvec3(r.y >> 8, r.z >> 5, r.w >> 2) & 8191u; }
uvec3 turns(uvec4 r) { return uvec3(r.y >> 21, r.z >> 18, r.w >> 15) & 255u; }
uvec3 sizes(uvec4 r) { return uvec3((r.y >> 29) | (r.z << 3), (r.z >> 26) | (r.w << 6), r.w >> 23) & 255u; }
`;

const GAUSSIAN = `
uniform usampler2D records, links, chunks;
struct Chunk { vec3 origin, step; float low, stride, first, last; };
Chunk chunkOf(uint row) {
  vec4 a = uintBitsToFloat(texelFetch(chunks, texel(2u * row), 0));
  vec4 b = uintBitsToFloat(texelFetch(chunks, texel(2u * row + 1u), 0));
  float rest = floor(b.w / 256.);
  return Chunk(a.xyz, b.xyz, a.w, b.w - 256. * rest, mod(rest, 16.), floor(rest / 16.));
}
vec3 awayFrom(vec3 eye, Chunk c, vec3 places) { // steps below 0 are those of sign(x) log(1 + |x|)
  if (c.step.x >= 0.) return (c.origin - eye) + places * c.step;
  vec3 u = c.origin - places * c.step;
  return sign(u) * (exp(abs(u)) - 1.) - eye;
}
`;

/** Project each Gaussian of the order: its center and the half axes of one standard deviation, in pixels. */
export function project(hsl: boolean): string {
  return HEAD + (hsl ? UNPACK_HSL : UNPACK_RGB) + GAUSSIAN + `
uniform usampler2D order, colors;
uniform int count;
uniform mat3 axes;
uniform vec3 eye;
uniform vec4 lens;
uniform vec2 size;
uniform bool antialiased;
layout(location = 0) out uvec4 shape;
layout(location = 1) out uvec4 paint;

void main() {
  shape = uvec4(0u);
  paint = uvec4(0u, 0u, 0u, floatBitsToUint(-1e9));
  ivec2 at = ivec2(gl_FragCoord.xy);
  if (at.y * ROW + at.x >= count) return;
  uint place = texelFetch(order, at, 0).x;
  ivec2 own = texel(place);
  uvec4 record = texelFetch(records, own, 0);
  Chunk chunk = chunkOf(texelFetch(links, own, 0).x & 0xffffffu);
  vec3 point = axes * awayFrom(eye, chunk, vec3(places(record)));
  float opacity = float(record.x & 255u) / 255.;
  if (point.z <= 0.01 || opacity * 255. < 0.999) return;

  vec4 q = vec4(0., (vec3(turns(record)) - HALF) * (0.70710678118654752 / HALF));
  q.x = sqrt(max(0., 1. - dot(q.yzw, q.yzw)));
  vec4 t = q * (2. / dot(q, q));
  float xx = t.y * q.y, yy = t.z * q.z, zz = t.w * q.w, xy = t.y * q.z, xz = t.y * q.w, yz = t.z * q.w;
  float wx = t.x * q.y, wy = t.x * q.z, wz = t.x * q.w;
  mat3 turn = mat3(1. - yy - zz, xy + wz, xz - wy, xy - wz, 1. - xx - zz, yz + wx, xz + wy, yz - wx, 1. - xx - yy);
  vec3 scale = exp2(clamp(chunk.low + vec3(sizes(record)) * chunk.stride, -8064., 8191.) / 64.);
  mat3 body = axes * turn;
  body[0] *= scale.x; body[1] *= scale.y; body[2] *= scale.z;

  vec2 slope = point.xy / point.z, margin = 0.15 * size;
  vec2 bent = clamp(slope, (-lens.zw - margin) / lens.xy, (size - lens.zw + margin) / lens.xy);
  vec2 per = lens.xy / point.z;
  vec3 m = per.x * (vec3(body[0].x, body[1].x, body[2].x) - bent.x * vec3(body[0].z, body[1].z, body[2].z));
  vec3 n = per.y * (vec3(body[0].y, body[1].y, body[2].y) - bent.y * vec3(body[0].z, body[1].z, body[2].z));
  vec3 area = cross(m, n);
  float a = dot(m, m), b = dot(m, n), c = dot(n, n), sharp = dot(area, area);
  float full = sharp + 0.3 * (a + c) + 0.09;
  if (antialiased) opacity *= sqrt(sharp / full);
  if (opacity * 255. < 0.999 || !(full < 1e30)) return;
  a += 0.3; c += 0.3;

  vec2 center = lens.xy * slope + lens.zw;
  float level = log2(opacity), reach = sqrt(1.3862943611 * max(0., 7.99435343 + level));
  vec2 half_ = reach * sqrt(vec2(a, c));
  if (any(lessThan(center + half_, vec2(0.5))) || any(greaterThan(center - half_, size - 0.5))) return;

  // Half axes: eigenvectors, without the cancellation of a - c or of the smaller eigenvalue.
  float e = 0.5 * (a - c), d = length(vec2(e, b)), long_ = 0.5 * (a + c) + d;
  vec2 along = e > 0. ? vec2(d + e, b) : vec2(b, d - e);
  float norm = length(along);
  along = norm > 0. ? along / norm : vec2(1., 0.);
  shape = uvec4(floatBitsToUint(center), floatBitsToUint(along * sqrt(long_)));
  uvec2 color = texelFetch(colors, own, 0).xy;
  paint = uvec4(color, floatBitsToUint(sqrt(full / long_)), floatBitsToUint(level));
}`;
}

/** Spread the quads over their ellipses, up to where alpha falls to 1/255. */
export const splatVertex = HEAD + `
uniform usampler2D shapes, paints;
uniform vec2 size;
out vec2 at;
flat out vec4 color;
void main() {
  uint i = uint(gl_InstanceID) * ${QUADS}u + uint(gl_VertexID >> 2);
  uvec4 paint = texelFetch(paints, texel(i), 0);
  float level = uintBitsToFloat(paint.w);
  gl_Position = vec4(2., 2., 0., 1.);
  at = vec2(0.);
  color = vec4(0.);
  if (level < -8.) return;
  vec4 shape = uintBitsToFloat(texelFetch(shapes, texel(i), 0));
  vec2 corner = vec2(gl_VertexID & 1, (gl_VertexID >> 1) & 1) * 2. - 1.;
  // In these units alpha = 2^(level - |at|^2): one standard deviation is sqrt(log2(e) / 2).
  at = corner * sqrt(max(0., level + 7.99435343) + 1e-6);
  vec2 sigma = at * 1.17741002252;
  vec2 across = vec2(-shape.w, shape.z) * inversesqrt(dot(shape.zw, shape.zw)) * uintBitsToFloat(paint.z);
  vec2 pixel = shape.xy + sigma.x * shape.zw + sigma.y * across;
  gl_Position = vec4(pixel / size * vec2(2., -2.) + vec2(-1., 1.), 0., 1.);
  color = vec4(unpackHalf2x16(paint.x), unpackHalf2x16(paint.y).x, level);
}`;

export const splatFragment = HEAD + `
in vec2 at;
flat in vec4 color;
out vec4 pixel;
void main() {
  float power = color.w - dot(at, at);
  if (power < -7.99435343) discard;
  float alpha = min(exp2(power), 0.999);
  pixel = vec4(color.rgb * alpha, alpha);
}`;

/** Lay the picture over the background. */
export const present = HEAD + `
uniform sampler2D picture;
uniform vec3 background;
uniform ivec2 offset;
out vec4 pixel;
void main() {
  vec4 c = texelFetch(picture, ivec2(gl_FragCoord.xy) - offset, 0);
  pixel = vec4(c.rgb + (1. - c.a) * background, 1.);
}`;

const RGB_BASE = `
vec3 basePlaces(uvec4 r) { return vec3((r.x >> 8) & 255u, (r.x >> 16) & 255u, r.x >> 24); }
`;
const HSL_TO_RGB = `
float channel(float shift, float hue, float chroma, float lightness) {
  float k = mod(shift + hue, 12.);
  return lightness - chroma * max(-1., min(min(k - 3., 9. - k), 1.));
}
vec3 toRgb(vec3 hsl, float factor) {
  float hue = 12. * fract(hsl.x), s = clamp(hsl.y, 0., 1.), l = clamp(hsl.z, 0., 1.), chroma = s * min(l, 1. - l);
  return max(vec3(channel(0., hue, chroma, l), channel(8., hue, chroma, l), channel(4., hue, chroma, l)), 0.) * factor;
}
`;

/** Where tables begin in the texture of tables, and the bits of a term's fields. */
export interface ColorLayout {
  hsl: boolean;
  base: [number, number, number];
  most: number; // last place in a table of base colors
  scales: number;
  mostScale: number;
  theta: number;
  phi: number;
  decays: number;
  intensities: number;
  mostIntensity: number;
  widths: number[]; // function, polar angle, azimuth, decay, each intensity
  degree: number; // of spherical harmonics
}

const int = (n: number) => `${n}u`;

/** Read the fields of a term and add what it brings along `x`. */
function addTerm(layout: ColorLayout): string {
  const lines: string[] = [];
  let bit = 0;
  const field = (name: string, width: number) => {
    const word = bit >> 5, shift = bit & 31, mask = 2 ** width - 1;
    const low = `(t.${"xy"[word]} >> ${int(shift)})`;
    const value = shift + width > 32 ? `(${low} | (t.y << ${int(32 - shift)}))` : low;
    lines.push(`uint ${name} = ${width ? `${value} & ${int(mask)}` : "0u"};`);
    bit += width;
  };
  field("f", layout.widths[0]);
  field("theta", layout.widths[1]);
  field("phi", layout.widths[2]);
  field("decay", layout.widths[3]);
  layout.widths.slice(4).forEach((width, k) => field(`i${k}`, width));
  const intensity = (k: number) => `entry(${int(layout.intensities)} + min(i${k}, ${int(layout.mostIntensity)})).x`;
  lines.push(
    `vec2 a = entry(${int(layout.theta)} + theta), b = entry(${int(layout.phi)} + phi);`,
    `float lobe = exp(entry(${int(layout.decays)} + decay).x * (dot(x, vec3(a.x * b.y, a.x * b.x, a.y)) - 1.));`,
    layout.hsl
      ? `if (f == 0u) color.y += lobe * base.y * ${intensity(0)}; else color.z += lobe * base.z * ${intensity(0)};`
      : `color += lobe * vec3(${[0, 1, 2].map(intensity).join(", ")});`,
  );
  return lines.join("\n    ");
}

/** Evaluate spherical harmonics of degree 1 to 3 from bytes: coefficient k of R, G, B at bytes 3 k and on. */
function addHarmonics(degree: number): string {
  const count = (degree + 1) ** 2 - 1, texels = Math.ceil((3 * count) / 16), lines: string[] = [];
  const basis = [
    "-0.4886025119 * x.y", "0.4886025119 * x.z", "-0.4886025119 * x.x",
    "1.0925484306 * x.x * x.y", "-1.0925484306 * x.y * x.z", "0.3153915653 * (2. * zz - xx - yy)",
    "-1.0925484306 * x.x * x.z",
    "0.5462742153 * (xx - yy)",
    "-0.5900435899 * x.y * (3. * xx - yy)", "2.8906114426 * x.x * x.y * x.z",
    "-0.4570457995 * x.y * (4. * zz - xx - yy)",
    "0.3731763326 * x.z * (2. * zz - 3. * xx - 3. * yy)", "-0.4570457995 * x.x * (4. * zz - xx - yy)",
    "1.4453057213 * x.z * (xx - yy)", "-0.5900435899 * x.x * (xx - 3. * yy)",
  ];
  lines.push(`uint label = texelFetch(labels, own, 0).x;`);
  lines.push("float xx = x.x * x.x, yy = x.y * x.y, zz = x.z * x.z;");
  for (let k = 0; k < texels; k++) {
    lines.push(`uvec4 h${k} = texelFetch(sets, texel(${texels}u * label + ${k}u), 0) ^ 0x80808080u;`);
  }
  const byte = (k: number) => `(h${k >> 4}.${"xyzw"[(k >> 2) & 3]} >> ${8 * (k & 3)}) & 255u`;
  for (let k = 0; k < count; k++) {
    const bytes = [0, 1, 2].map((c) => byte(3 * k + c)).join(", ");
    lines.push(`color += (${basis[k]}) * (lows[${k}] + spans[${k}] * vec3(${bytes}));`);
  }
  return lines.join("\n  ");
}

/** Find the color of every Gaussian of some rows, as two pairs of half floats. */
export function colors(layout: ColorLayout): string {
  const count = (layout.degree + 1) ** 2 - 1;
  return HEAD + (layout.hsl ? UNPACK_HSL + HSL_TO_RGB : UNPACK_RGB) + GAUSSIAN + RGB_BASE + `
uniform usampler2D heads, terms, labels, sets;
uniform sampler2D tables;
uniform int mode, levels;
uniform bool detailed;
uniform float total;
uniform vec3 eye;
${count ? `uniform vec3 lows[${count}], spans[${count}];` : ""}
out uvec2 found;
vec2 entry(uint i) { return texelFetch(tables, ivec2(int(i & 1023u), int(i >> 10)), 0).xy; }
vec3 ramp(float t) {
  t = 4. * clamp(t, 0., 1.);
  vec3 c = mix(vec3(.13, .11, .36), vec3(.17, .37, .62), clamp(t, 0., 1.));
  c = mix(c, vec3(.16, .62, .56), clamp(t - 1., 0., 1.));
  c = mix(c, vec3(.66, .80, .30), clamp(t - 2., 0., 1.));
  return mix(c, vec3(.99, .91, .42), clamp(t - 3., 0., 1.));
}
uint countTerms(uint place) {
  uint n = 0u;
  for (uint k = texelFetch(heads, texel(place), 0).x; k != 0u && n < 255u; n++) {
    k = texelFetch(terms, texel(k - 1u), 0).z;
  }
  return n;
}
void main() {
  ivec2 own = ivec2(gl_FragCoord.xy);
  uint place = uint(own.y * ROW + own.x);
  uvec4 record = texelFetch(records, own, 0);
  uvec2 link = texelFetch(links, own, 0).xy;
  Chunk chunk = chunkOf(link.x & 0xffffffu);
  vec3 away = awayFrom(eye, chunk, vec3(places(record)));
  float distance_ = length(away);
  vec3 x = distance_ > 0. ? away / distance_ : vec3(0., 0., 1.), color;
  if (mode == 1) color = ramp(float(record.x & 255u) / 255.);
  else if (mode == 2) color = ramp(levels > 1 ? chunk.last / float(levels - 1) : 1.);
  else if (mode == 3) color = ramp(float(link.y) / total);
  else if (mode == 4) color = detailed ? ramp(float(countTerms(place)) / total) : ramp(0.);
  else if (mode == 6) color = ramp(float(link.x >> 24) / 255.);
  else if (mode == 5) color = ramp(1. - distance_ / (distance_ + total));
  else {
    uvec3 places_ = uvec3(min(basePlaces(record), ${layout.most}.));
    vec3 base = vec3(entry(${int(layout.base[0])} + places_.x).x, entry(${int(layout.base[1])} + places_.y).x,
      entry(${int(layout.base[2])} + places_.z).x);
    color = base;
    ${count ? `if (detailed) {\n  ${addHarmonics(layout.degree)}\n  }` : `if (detailed) {
    uint n = 0u;
    for (uint k = texelFetch(heads, texel(place), 0).x; k != 0u && n < 255u; n++) {
    uvec4 t = texelFetch(terms, texel(k - 1u), 0);
    k = t.z;
    ${addTerm(layout)}
    }
    }`}
    color = ${layout.hsl
      ? `toRgb(color, entry(${int(layout.scales)} + min(record.y & 255u, ${int(layout.mostScale)})).x)`
      : "max(color, 0.)"};
  }
  color = min(color, 65504.);
  found = uvec2(packHalf2x16(color.rg), packHalf2x16(vec2(color.b, 0.)));
}`;
}

/** A program of the GPU; `at` finds uniforms by name. */
export interface Program {
  program: WebGLProgram;
  use(): void; // from now on
  at(name: string): WebGLUniformLocation | null;
}

/** Begin to compile a program. Its first use waits until that is done, and raises where it is no good. */
export function compile(gl: WebGL2RenderingContext, vertex: string, fragment: string): Program {
  const program = gl.createProgram(), found = new Map<string, WebGLUniformLocation | null>();
  let isKnown = false;
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]] as const) {
    const shader = gl.createShader(kind);
    if (!shader) throw new Error("the graphics context is lost");
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
    gl.deleteShader(shader);
  }
  gl.linkProgram(program);
  return {
    program,
    use() {
      if (!isKnown && !gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
        const said = gl.getAttachedShaders(program)?.map((shader) => gl.getShaderInfoLog(shader)).join(" ");
        throw new Error(`A program of the viewer does not compile here: ${said} ${gl.getProgramInfoLog(program)}`);
      }
      isKnown = true;
      gl.useProgram(program);
    },
    at(name) {
      if (!found.has(name)) found.set(name, gl.getUniformLocation(program, name));
      return found.get(name) ?? null;
    },
  };
}
