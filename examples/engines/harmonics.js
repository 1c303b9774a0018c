// Colors that change with the direction, of splats that `sog.js` has read: GLSL for engines that draw by themselves, and what its textures hold. No dependencies.
// A splat has a byte for each coefficient and channel, as in its SOG. What bytes stand for differs from leaf to leaf: so each leaf has a row of levels.

const WIDTH = 512; // splats in a row of texels
const LEVELS = 513; // in a row of a leaf: 256 of harmonics, 256 of base colors, the degree

export const HARMONICS = `
  uniform highp usampler2D sets;
  uniform highp sampler2D levels;
  vec3 levelsOf(uint words[12], int term, int first, int leaf) {
    vec3 found;
    for (int c = 0; c < 3; c++) {
      int at = 3 * term + c;
      int level = first + int(words[at / 4] >> (8 * (at % 4)) & 255u);
      found[c] = texelFetch(levels, ivec2(level, leaf), 0).r;
    }
    return found;
  }
  // The color of a splat; d: the direction from the eye to it, of length 1, frame of the scene.
  vec3 colorOf(int splat, int leaf, vec3 d) {
    uint words[12];
    for (int k = 0; k < 3; k++) {
      uvec4 four = texelFetch(sets, ivec2(3 * (splat % ${WIDTH}) + k, splat / ${WIDTH}), 0);
      for (int j = 0; j < 4; j++) words[4 * k + j] = four[j];
    }
    float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
    float basis[15] = float[15](
      -0.48860251 * y, 0.48860251 * z, -0.48860251 * x,
      1.09254843 * x * y, -1.09254843 * y * z, 0.31539157 * (2.0 * zz - xx - yy), -1.09254843 * x * z, 0.54627422 * (xx - yy),
      -0.59004359 * y * (3.0 * xx - yy), 2.89061144 * x * y * z, -0.45704580 * y * (4.0 * zz - xx - yy),
      0.37317633 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy), -0.45704580 * x * (4.0 * zz - xx - yy),
      1.44530572 * z * (xx - yy), -0.59004359 * x * (xx - 3.0 * yy)
    );
    int degree = int(texelFetch(levels, ivec2(512, leaf), 0).r);
    vec3 color = levelsOf(words, 15, 256, leaf);
    for (int k = 0; k < degree * (degree + 2); k++) color += basis[k] * levelsOf(words, k, 0, leaf);
    return max(color, 0.0);
  }`;

/** Returns what the textures `sets` (RGBA32UI) and `levels` (R32F) hold for leaves, one after the other, and their sizes; null without any harmonics. */
export function joinHarmonics(leaves) {
  if (!leaves.some(({ harmonics }) => harmonics)) return null;
  const count = leaves.reduce((sum, { splats }) => sum + splats.length / 32, 0), rows = Math.max(Math.ceil(count / WIDTH), 1);
  const bytes = new Uint8Array(48 * WIDTH * rows), levels = new Float32Array(LEVELS * leaves.length);
  let at = 0;
  leaves.forEach(({ splats, harmonics }, leaf) => {
    const { degree, bytes: own, levels: of } = harmonics ?? plain(splats);
    bytes.set(own, at);
    at += own.length;
    levels.set(of, LEVELS * leaf);
    levels[LEVELS * leaf + 512] = degree;
  });
  return { sets: new Uint32Array(bytes.buffer), levels, width: 3 * WIDTH, levelsWidth: LEVELS };
}

/** Returns what stands for the harmonics of a leaf that has base colors alone. */
function plain(splats) {
  const count = splats.length / 32, bytes = new Uint8Array(48 * count);
  for (let k = 0; k < count; k++) bytes.set(splats.subarray(32 * k + 24, 32 * k + 27), 48 * k + 45);
  return { degree: 0, bytes, levels: Float32Array.from({ length: 512 }, (_, k) => (k % 256) / 255) };
}
