// Reads a SOG (version 2) as 32 bytes a splat: position and standard deviations (6 float32), color and opacity (4 bytes),
// quaternion (4 bytes, w first, 0 to 255 for -1 to 1); and its harmonics as `harmonics.js` takes them. No dependencies.

/** Returns the four bytes of each pixel of an image. A canvas would multiply colors with alpha, and lose them. */
async function pixels(url, gl) {
  const answer = await fetch(url);
  if (!answer.ok) throw new Error(`${url}: HTTP ${answer.status}`);
  const image = await createImageBitmap(await answer.blob(), { premultiplyAlpha: "none", colorSpaceConversion: "none" });
  gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
  gl.bindFramebuffer(gl.FRAMEBUFFER, gl.createFramebuffer());
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, image);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, gl.getParameter(gl.TEXTURE_BINDING_2D), 0);
  const bytes = new Uint8Array(4 * image.width * image.height);
  gl.readPixels(0, 0, image.width, image.height, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
  gl.deleteTexture(gl.getParameter(gl.TEXTURE_BINDING_2D));
  gl.deleteFramebuffer(gl.getParameter(gl.FRAMEBUFFER_BINDING));
  return bytes;
}

const SH0 = Math.sqrt(1 / (4 * Math.PI));
let context = null;

/** Returns 48 bytes a splat: one for each of 15 coefficients and each channel, and those of its base color; and what bytes stand for. */
function expand({ shN, sh0, count }, [centroids, labels], color) {
  const terms = shN.bands * (shN.bands + 2), bytes = new Uint8Array(48 * count), levels = new Float32Array(512);
  levels.set(shN.codebook);
  levels.set(sh0.codebook.map((value) => 0.5 + SH0 * value), 256);
  for (let k = 0; k < count; k++) {
    const set = labels[4 * k] + 256 * labels[4 * k + 1];
    for (let channel = 0; channel < 3; channel++) {
      for (let term = 0; term < terms; term++) bytes[48 * k + 3 * term + channel] = centroids[4 * (terms * set + term) + channel];
      bytes[48 * k + 45 + channel] = color[4 * k + channel];
    }
  }
  return { degree: shN.bands, bytes, levels };
}

/** Returns `splats`, 32 bytes each, and their `harmonics`, null without any, from the address of a `meta.json`. */
export async function readSog(url) {
  const answer = await fetch(url);
  if (!answer.ok) throw new Error(`${url}: HTTP ${answer.status}`);
  const meta = await answer.json();
  if (meta.version !== 2) throw new Error(`${url}: a SOG of version ${meta.version}, not 2`);
  context ??= new OffscreenCanvas(1, 1).getContext("webgl2");
  const { means, scales, quats, sh0, shN } = meta, base = new URL(url, location.href);
  const read = (name) => pixels(new URL(name, base), context);
  const [low, high, scale, quat, color] = await Promise.all([...means.files, ...scales.files, ...quats.files, ...sh0.files].map(read));
  const harmonics = shN?.bands ? expand(meta, await Promise.all(shN.files.map(read)), color) : null;
  const bytes = new Uint8Array(32 * meta.count), floats = new Float32Array(bytes.buffer), levels = new Uint8ClampedArray(bytes.buffer);
  const deviations = scales.codebook.map(Math.exp), colors = sh0.codebook.map((value) => 255 * (0.5 + SH0 * value));
  for (let k = 0, at = 0; k < meta.count; k++, at += 4) {
    for (let axis = 0; axis < 3; axis++) {
      const share = (256 * high[at + axis] + low[at + axis]) / 65535;
      const log = means.mins[axis] + share * (means.maxs[axis] - means.mins[axis]);
      floats[8 * k + axis] = Math.sign(log) * Math.expm1(Math.abs(log));
      floats[8 * k + 3 + axis] = deviations[scale[at + axis]];
      levels[32 * k + 24 + axis] = colors[color[at + axis]];
    }
    levels[32 * k + 27] = color[at + 3];
    const three = [0, 1, 2].map((part) => (quat[at + part] / 127.5 - 1) * Math.SQRT1_2);
    three.splice(quat[at + 3] - 252, 0, Math.sqrt(Math.max(0, 1 - three.reduce((sum, q) => sum + q * q, 0)))); // the largest is not stored
    three.forEach((q, part) => { levels[32 * k + 28 + part] = 127.5 * (q + 1); });
  }
  return { splats: bytes, harmonics };
}
