// A globe of the 80 directions around a Gaussian as the visitor sees it: faces from which it can be seen are filled.

import { draw } from "./dom.ts";
import { cross, dot, normalize, scale, add, subtract } from "./vector.ts";
import type { Vec3 } from "./vector.ts";

interface Face {
  corners: [Vec3, Vec3, Vec3];
  center: Vec3;
}

/** Return the 80 faces of the once-subdivided icosahedron. */
export function globeFaces(): Face[] {
  const phi = (1 + Math.sqrt(5)) / 2;
  const corners: Vec3[] = [];
  for (const s of [1, -1]) for (const t of [phi, -phi]) corners.push([0, s, t], [s, t, 0], [t, 0, s]);
  const near = (a: Vec3, b: Vec3): boolean => Math.abs(dot(subtract(a, b), subtract(a, b)) - 4) < 1e-6;
  const faces: Face[] = [];
  const push = (...three: [Vec3, Vec3, Vec3]): void =>
    void faces.push({ corners: three, center: normalize(add(add(three[0], three[1]), three[2])) });
  for (let i = 0; i < 12; i++) {
    for (let j = i + 1; j < 12; j++) {
      for (let k = j + 1; k < 12; k++) {
        const [a, b, c] = [corners[i], corners[j], corners[k]];
        if (!near(a, b) || !near(b, c) || !near(a, c)) continue;
        const [x, y, z] = [normalize(a), normalize(b), normalize(c)];
        const [xy, yz, zx] = [normalize(add(x, y)), normalize(add(y, z)), normalize(add(z, x))];
        push(x, xy, zx);
        push(y, yz, xy);
        push(z, zx, yz);
        push(xy, yz, zx);
      }
    }
  }
  return faces;
}

/** Return which of the faces are seen: those whose center is nearest to one of the directions. */
export function matchFaces(faces: readonly Face[], seen: readonly Vec3[]): boolean[] {
  const found = faces.map(() => false);
  for (const direction of seen) {
    let best = 0;
    faces.forEach((face, i) => {
      if (dot(face.center, direction) > dot(faces[best].center, direction)) best = i;
    });
    found[best] = true;
  }
  return found;
}

/** Draw the globe as an eye in the direction `toEye` sees it, with `up` upwards. */
export function drawGlobe(seen: readonly Vec3[], toEye: Vec3, up: Vec3): SVGSVGElement {
  const faces = globeFaces();
  const lit = matchFaces(faces, seen);
  const z = normalize(toEye);
  const level = cross(up, z);
  const x = normalize(level, cross([z[1], z[2], z[0]], z));
  const y = cross(z, x);
  const svg = draw(
    "svg", { viewBox: "-52 -52 104 104", class: "globe", "aria-hidden": "true" },
    draw("circle", { r: 50, class: "rim" }),
  );
  const order = faces.map(
    (face, i) => ({ face, lit: lit[i], depth: dot(face.center, z) }),
  ).sort((a, b) => a.depth - b.depth);
  for (const { face, lit: shown, depth } of order) {
    if (depth < 0 && !shown) continue;
    const points = face.corners.map((corner) => scale(corner, 50)).map(
      (p) => `${dot(p, x).toFixed(1)},${(-dot(p, y)).toFixed(1)}`,
    );
    const side = depth < 0 ? "back" : "front";
    svg.append(draw("polygon", { points: points.join(" "), class: `${side}${shown ? " seen" : ""}` }));
  }
  return svg;
}
