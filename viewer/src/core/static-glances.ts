// Which glances of a cell an eye needs: those of the sectors of the horizon that its view covers, while it has little.
import { rotationOf } from "./camera.ts";
import { HELD } from "./static-plan.ts";
import type { Holdings } from "./static-plan.ts";
import type { StaticScene } from "./static-scene.ts";
import type { Pose, View } from "./types.ts";

const LITTLE = 0.5; // share of the light in view that is missing at least
const COVERED = 0.08; // share of a view that a sector has at least
const LOOKS = 24; // directions along each axis of a view

/** Return whether so much of the light in view is missing that glances are worth their bytes. */
export function hasLittle(worth: Float32Array, { part, left }: Holdings): boolean {
  let all = 0, missing = 0;
  worth.forEach((light, p) => {
    all += light;
    if (part[p] !== HELD) missing += light * left[p] ** 2;
  });
  return missing > LITTLE * all;
}

/** Return the sectors of the horizon that a view covers, the one with the most of it first. */
export function sectorsOf(glances: NonNullable<StaticScene["cells"]["glances"]>, pose: Pose, view: View): number[] {
  const { sectors, axes: [east, north] } = glances, turn = rotationOf(pose.rotation);
  const covered = new Float64Array(sectors);
  let all = 0;
  for (let i = 0; i < LOOKS; i++) {
    for (let j = 0; j < LOOKS; j++) {
      const x = (view.left + view.right) * ((i + 0.5) / LOOKS) - view.left;
      const y = (view.up + view.down) * ((j + 0.5) / LOOKS) - view.up;
      const ahead = [0, 1, 2].map((row) => turn[3 * row] * x + turn[3 * row + 1] * y + turn[3 * row + 2]);
      const along = (axis: readonly number[]): number => axis.reduce((sum, v, k) => sum + v * ahead[k], 0);
      const share = Math.atan2(along(north), along(east)) / (2 * Math.PI) + 0.5, angle = (1 + x * x + y * y) ** -1.5;
      covered[Math.floor(share * sectors) % sectors] += angle;
      all += angle;
    }
  }
  const order = [...covered.keys()].sort((a, b) => covered[b] - covered[a]);
  return order.filter((sector) => covered[sector] > COVERED * all);
}
