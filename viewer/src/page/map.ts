// A small map of the cells from above: which of them see a Gaussian, where it is, and where the visitor stands.

import { draw } from "./dom.ts";
import type { Cells, Sight } from "./facts.ts";
import { forward } from "./rig.ts";
import type { Rig } from "./rig.ts";
import { add, boundsOf, dot, scale } from "./vector.ts";
import type { Frame, Vec3 } from "./vector.ts";

const SIDE = 200; // of the picture, its own units
const MARGIN = 8;

export function drawMap(cells: Cells, seeing: readonly Sight[], at: Vec3, rig: Rig, frame: Frame): SVGSVGElement {
  const flat = (p: Vec3): [number, number] => [dot(p, frame.east), -dot(p, frame.north)];
  const half = cells.size / 2;
  const centers = cells.boxes.map((box) => flat(add(cells.origin, scale(add(box, [0.5, 0.5, 0.5]), cells.size))));
  const all = [...centers, flat(at), flat(rig.eye)];
  const bounds = [0, 1].map((k) => boundsOf(all.map((p) => p[k])));
  const low = bounds.map(([least]) => least - half), high = bounds.map(([, most]) => most + half);
  const size = Math.max(high[0] - low[0], high[1] - low[1], 1e-9);
  const zoom = (SIDE - 2 * MARGIN) / size;
  const place = ([x, y]: [number, number]): [number, number] => [
    SIDE / 2 + (x - (low[0] + high[0]) / 2) * zoom, SIDE / 2 + (y - (low[1] + high[1]) / 2) * zoom,
  ];
  const columns = new Map<string, { at: [number, number]; weight: number }>();
  const weights = new Map(seeing.map((sight) => [sight.cell, Math.max(sight.weight?.[1] ?? 0.02, 0.02)]));
  centers.forEach((center, cell) => {
    const [x, y] = place(center);
    const key = `${Math.round(x * 4)} ${Math.round(y * 4)}`;
    const known = columns.get(key);
    columns.set(key, { at: [x, y], weight: Math.max(known?.weight ?? 0, weights.get(cell) ?? 0) });
  });
  const side = Math.max(cells.size * zoom - 0.6, 1);
  const svg = draw("svg", { viewBox: `0 0 ${SIDE} ${SIDE}`, class: "map", "aria-hidden": "true" });
  for (const { at: [x, y], weight } of columns.values()) {
    const box = draw(
      "rect",
      {
        x: x - side / 2, y: y - side / 2, width: side, height: side, rx: Math.min(1.5, side / 4),
        class: weight ? "seeing" : "cell",
      },
    );
    if (weight) box.style.setProperty("opacity", String(0.35 + 0.65 * Math.min(1, Math.sqrt(weight))));
    svg.append(box);
  }
  const [gx, gy] = place(flat(at));
  const [ex, ey] = place(flat(rig.eye));
  const [dx, dy] = flat(forward({ ...rig, tilt: 0 }, frame));
  const turned = (Math.atan2(dy, dx) * 180) / Math.PI;
  svg.append(
    draw("line", { x1: ex, y1: ey, x2: gx, y2: gy, class: "sight" }),
    draw("circle", { cx: gx, cy: gy, r: 4, class: "gaussian" }),
    draw(
      "path", { d: "M9 0L-5 5.5L-2.5 0L-5 -5.5z", class: "eye", transform: `translate(${ex} ${ey}) rotate(${turned})` },
    ),
  );
  return svg;
}
