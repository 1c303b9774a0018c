// Draws the cells as lines over the scene: the boxes that visible sets are made for.

import { make } from "./dom.ts";
import type { Cells } from "./facts.ts";
import { forward, right } from "./rig.ts";
import type { Rig } from "./rig.ts";
import { cross, dot, subtract } from "./vector.ts";
import type { Frame, Vec3 } from "./vector.ts";

const NEAR = 0.02; // of a cell
const MOST_BOXES = 20_000; // more lines than these would hide the scene
const SHARES = [0.15, 0.3, 0.55, 0.9]; // of opacity, far to near

/** Return the edges of cells, each once: its lower corner in cells and the axis along which it runs. */
export function edgesOf(cells: Cells): { at: Vec3; axis: number }[] {
  const edges = new Map<string, { at: Vec3; axis: number }>();
  for (const box of cells.boxes) {
    for (let axis = 0; axis < 3; axis++) {
      for (const [b, c] of [[0, 0], [0, 1], [1, 0], [1, 1]]) {
        const at: Vec3 = [...box];
        at[(axis + 1) % 3] += b;
        at[(axis + 2) % 3] += c;
        edges.set(`${at} ${axis}`, { at, axis });
      }
    }
  }
  return [...edges.values()];
}

export class Overlay {
  readonly element = make("canvas", { class: "overlay", "aria-hidden": "true", hidden: true });
  #cells: Cells | null = null;
  #edges: { at: Vec3; axis: number }[] = [];

  set(cells: Cells | null): void {
    this.#cells = cells;
    this.#edges = cells && cells.boxes.length <= MOST_BOXES ? edgesOf(cells) : [];
  }

  get known(): boolean {
    return this.#edges.length > 0;
  }

  draw(rig: Rig, frame: Frame): void {
    const { element } = this, cells = this.#cells;
    const context = element.hidden || !cells ? null : element.getContext("2d");
    if (!context || !cells) return;
    const ratio = Math.min(devicePixelRatio || 1, 2);
    const [width, height] = [element.clientWidth * ratio, element.clientHeight * ratio].map(Math.round);
    if (element.width !== width || element.height !== height) [element.width, element.height] = [width, height];
    context.clearRect(0, 0, width, height);
    context.strokeStyle = getComputedStyle(element).color;
    context.lineWidth = ratio;
    const [z, x] = [forward(rig, frame), right(rig, frame)];
    const y = cross(z, x);
    const focal = height / 2 / Math.tan(rig.fovY / 2);
    const near = NEAR * cells.size;
    const see = (corner: Vec3): Vec3 => {
      const offset = subtract([0, 1, 2].map((k) => cells.origin[k] + corner[k] * cells.size) as Vec3, rig.eye);
      return [dot(offset, x), dot(offset, y), dot(offset, z)];
    };
    const paths = SHARES.map(() => new Path2D());
    for (const { at, axis } of this.#edges) {
      const end: Vec3 = [...at];
      end[axis] += 1;
      const line = clip(see(at), see(end), near);
      if (!line) continue;
      const depth = Math.min(line[0][2], line[1][2]) / cells.size;
      const path = paths[depth < 2 ? 3 : depth < 5 ? 2 : depth < 10 ? 1 : 0];
      const [a, b] = line.map((p) => [width / 2 + (focal * p[0]) / p[2], height / 2 + (focal * p[1]) / p[2]]);
      path.moveTo(a[0], a[1]);
      path.lineTo(b[0], b[1]);
    }
    paths.forEach((path, i) => {
      context.globalAlpha = SHARES[i];
      context.stroke(path);
    });
    context.globalAlpha = 1;
  }
}

/** Return the part of a line that lies in front of the eye. */
function clip(a: Vec3, b: Vec3, near: number): [Vec3, Vec3] | null {
  if (a[2] < near && b[2] < near) return null;
  const cut = (from: Vec3, to: Vec3): Vec3 => {
    if (from[2] >= near) return from;
    const t = (near - from[2]) / (to[2] - from[2]);
    return [from[0] + t * (to[0] - from[0]), from[1] + t * (to[1] - from[1]), near];
  };
  return [cut(a, b), cut(b, a)];
}
