// Files of Gaussians that were chosen one by one: of a first view of a static scene, and of a glance from a cell. They say
// what they leave of each part, and their pieces are read while they come.
import { pieceBytes } from "./static-pieces.ts";
import type { StaticScene } from "./static-scene.ts";
import { damaged, inflate } from "./static-tables.ts";
import type { Pose } from "./types.ts";

const NEAR = 0.3; // sides of a cell from the view that is still the same
const TURN = 0.35; // radians

/** Pieces, behind the shares of the light of parts that they leave. */
export class PieceFile {
  #data = new Uint8Array(0); // what has come and makes no piece yet
  #shares: Uint8Array | null = null; // compressed

  constructor(protected readonly scene: StaticScene, readonly where: string) {}

  /** Take what has come, and return the pieces that are whole. */
  take(data: Uint8Array): Uint8Array[] {
    const all = new Uint8Array(this.#data.length + data.length), found: Uint8Array[] = [];
    all.set(this.#data);
    all.set(data, this.#data.length);
    let at = 0;
    for (;;) {
      const rest = all.subarray(at);
      const bytes = this.#shares !== null
        ? pieceBytes(rest, this.where)
        : rest.length < 4 ? 0 : 4 + new DataView(rest.buffer, rest.byteOffset).getUint32(0, true);
      if (bytes === 0 || bytes > rest.length) break;
      if (this.#shares === null) this.#shares = rest.slice(4, bytes);
      else found.push(rest.slice(0, bytes));
      at += bytes;
    }
    this.#data = all.slice(at);
    return found;
  }

  /** Return the share of the light of each part that the file did not bring. */
  async left(): Promise<Float32Array> {
    const { where } = this, { parts } = this.scene;
    if (this.#shares === null || this.#data.length > 0) throw damaged(where);
    const shares = await inflate(this.#shares, parts, where);
    if (shares.length !== parts) throw damaged(where);
    return Float32Array.from(shares, (share) => share / 255);
  }
}

/** The file of a first view. */
export class FirstView extends PieceFile {
  isAsked = false;
  isOver = false; // it is here, or lost

  constructor(scene: StaticScene, readonly number: number) {
    super(scene, `first view ${number}`);
  }

  get bytes(): number {
    return this.scene.first[this.number].bytes;
  }

  /** Return whether an eye sees about what the file is for. */
  isFor(pose: Pose): boolean {
    const { position, rotation } = this.scene.first[this.number].pose;
    const away = Math.hypot(...position.map((v, k) => v - pose.position[k]));
    const cosine = Math.abs(rotation.reduce((sum, v, k) => sum + v * pose.rotation[k], 0));
    const norms = Math.hypot(...rotation) * Math.hypot(...pose.rotation);
    return away <= NEAR * this.scene.cells.size && 2 * Math.acos(Math.min(cosine / norms, 1)) <= TURN;
  }
}
