// The first view of a scene whose address and settings name none: on the floor where there is most room, or at a cell.

import type { Cells } from "./facts.ts";
import type { Floor } from "./ground.ts";
import { NORMAL_FOV, rigFromTarget } from "./rig.ts";
import type { Rig } from "./rig.ts";
import { add, boundsOf, dot, scale, subtract } from "./vector.ts";
import type { Frame, Vec3 } from "./vector.ts";

const WAYS = 16; // directions looked at from the first place

/** Stand where the floor is widest, and look where it reaches farthest. */
export function startOnFloor(floor: Floor, frame: Frame): Rig | null {
  const { columns, rows, heights } = floor;
  const free = (x: number, y: number): boolean =>
    x >= 0 && y >= 0 && x < columns && y < rows && Number.isFinite(heights[Math.floor(y) * columns + Math.floor(x)]);
  const room = roomOf(floor);
  let best = -1;
  for (let i = 0; i < room.length; i++) if (room[i] > 0 && (best < 0 || room[i] > room[best])) best = i;
  if (best < 0) return null;
  const [x, y] = [(best % columns) + 0.5, Math.floor(best / columns) + 0.5];
  let [farthest, way] = [-1, 0];
  for (let k = 0; k < WAYS; k++) {
    const angle = (2 * Math.PI * k) / WAYS;
    let far = 0;
    while (free(x + Math.cos(angle) * (far + 0.5), y + Math.sin(angle) * (far + 0.5))) far += 0.5;
    if (far > farthest) [farthest, way] = [far, angle];
  }
  const at = (p: number, q: number): Vec3 =>
    add(
      add(floor.origin, scale(floor.first, p * floor.side)),
      add(scale(floor.second, q * floor.side), scale(floor.up, heights[best])),
    );
  const away = Math.max(farthest, 2);
  return rigFromTarget(at(x, y), at(x + Math.cos(way) * away, y + Math.sin(way) * away), frame, NORMAL_FOV);
}

/** Stand in the cell nearest to the middle of all cells, and look along the longer level side of their box. */
export function startInCells(cells: Cells, frame: Frame): Rig | null {
  if (cells.boxes.length === 0) return null;
  const centers = cells.boxes.map((box) => add(cells.origin, scale(add(box, [0.5, 0.5, 0.5]), cells.size)));
  const middle = scale(centers.reduce(add), 1 / centers.length);
  const away = (center: Vec3): number => dot(subtract(center, middle), subtract(center, middle));
  const eye = centers.reduce((a, b) => (away(b) < away(a) ? b : a));
  const reach = (axis: Vec3): number => boundsOf(centers.map((center) => dot(subtract(center, eye), axis)))[1];
  const axes = [frame.north, frame.east, scale(frame.north, -1), scale(frame.east, -1)];
  const ahead = axes.reduce((a, b) => (reach(b) > reach(a) + 1e-9 ? b : a));
  return rigFromTarget(eye, add(eye, scale(ahead, Math.max(reach(ahead), cells.size))), frame, NORMAL_FOV);
}

/** Return the middle of cells that stand all around something, such as a statue; null where they fill their space. */
export function surroundedBy(cells: Cells, frame: Frame): Vec3 | null {
  if (cells.boxes.length < 8) return null;
  const centers = cells.boxes.map((box) => add(cells.origin, scale(add(box, [0.5, 0.5, 0.5]), cells.size)));
  const middle = scale(centers.reduce(add), 1 / centers.length);
  const sectors = new Set<number>();
  for (const center of centers) {
    const offset = subtract(center, middle);
    const [x, y] = [dot(offset, frame.east), dot(offset, frame.north)];
    if (Math.hypot(x, y) < 1.2 * cells.size) return null;
    sectors.add(Math.floor(((Math.atan2(y, x) / Math.PI + 1) * 8) / 2) % 8);
  }
  return sectors.size >= 7 ? middle : null;
}

/** Return for each square how many squares away the floor ends, 0 where nobody can stand. */
function roomOf({ columns, rows, heights }: Floor): Float32Array {
  const room = new Float32Array(columns * rows);
  const at = (x: number, y: number): number =>
    (x < 0 || y < 0 || x >= columns || y >= rows ? 0 : room[y * columns + x]);
  for (let y = 0; y < rows; y++) {
    for (let x = 0; x < columns; x++) {
      if (!Number.isFinite(heights[y * columns + x])) continue;
      room[y * columns + x] = 1 + Math.min(
        at(x - 1, y), at(x, y - 1), 0.414 + at(x - 1, y - 1), 0.414 + at(x + 1, y - 1),
      );
    }
  }
  for (let y = rows - 1; y >= 0; y--) {
    for (let x = columns - 1; x >= 0; x--) {
      const near = 1 + Math.min(at(x + 1, y), at(x, y + 1), 0.414 + at(x + 1, y + 1), 0.414 + at(x - 1, y + 1));
      room[y * columns + x] = Math.min(room[y * columns + x], near);
    }
  }
  return room;
}
