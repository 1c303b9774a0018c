// Textures of unsigned integers that are filled from the first texel on; only the layers that changed go to the GPU.
import * as THREE from "three";

const WIDTH = 1024, HEIGHT = 64, LAYER = WIDTH * HEIGHT;
const FORMATS = {
  1: [THREE.RedIntegerFormat, "R32UI"],
  2: [THREE.RGIntegerFormat, "RG32UI"],
  4: [THREE.RGBAIntegerFormat, "RGBA32UI"],
};

/** The place of texel i in the textures below. */
export const TEXEL_GLSL = "ivec3 gsvisTexel(int i) { return ivec3(i & 1023, (i >> 10) & 63, i >> 16); }";

/** Room for `texels` of 1, 2 or 4 numbers. */
export class Texels {
  constructor(texels, channels) {
    const layers = Math.max(1, Math.ceil(texels / LAYER)), [format, internalFormat] = FORMATS[channels];
    this.channels = channels;
    this.data = new Uint32Array(layers * LAYER * channels);
    this.texture = new THREE.DataArrayTexture(this.data, WIDTH, HEIGHT, layers);
    Object.assign(this.texture, { format, internalFormat, type: THREE.UnsignedIntType, needsUpdate: true });
  }

  /** Write numbers from texel `first` on. */
  write(first, numbers) {
    this.data.set(numbers, first * this.channels);
    this.touch(first, first + numbers.length / this.channels - 1);
  }

  /** The texels from `first` to `last` have changed. */
  touch(first, last) {
    for (let layer = Math.floor(first / LAYER); layer <= Math.floor(last / LAYER); layer++) this.texture.addLayerUpdate(layer);
    this.texture.needsUpdate = true;
  }

  dispose() {
    this.texture.dispose();
  }
}
