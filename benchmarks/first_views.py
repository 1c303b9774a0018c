"""Does a visit begin well: the object whole in the picture, eyes where people stand, nothing right in front of them?

The first views of each scene, as `gsvis view` and `gsvis export` find them, are drawn with the field of view of the
page, 60 degrees high, 4 by 3. Pictures go to --sheets, one sheet for a scene, and are looked at by a person; those of
real scenes are not for the repository.

Given: scenes (--scenes: a path, PATH@LOD or builtin:NAME).
Measured: for each view the share of the projected box around the scene's detail that lies inside the picture, the share
    of pixels with an alpha of a half, and the distance from the eye to the nearest Gaussian of an opacity of a half in
    front of it, in the diagonal of that box; for each scene the way to move. Whole: of scenes that begin in orbit, the
    least share of the box that the first view shows.
Defaults chosen on: these scenes.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from _harness import add_arguments, write_result
from PIL import Image

from gsvis.export.start import plan_visit
from gsvis.io.sources import load_source
from gsvis.render import rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.core import find_core
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.poses import cameras_from_poses

WIDTH, HEIGHT = 400, 300
FOV = float(np.degrees(2 * np.arctan(np.tan(np.radians(30.0)) * WIDTH / HEIGHT)))


def measure(g: Gaussians, camera: Cameras, low: np.ndarray, high: np.ndarray, alphas: np.ndarray) -> dict[str, float]:
    """Return the figures of one view."""
    grid = np.stack(np.meshgrid(*[np.linspace(a, b, 9) for a, b in zip(low, high, strict=True)], indexing="ij"), -1)
    viewmat = camera.viewmats[0]
    x, y, z = (grid.reshape(-1, 3) @ viewmat[:3, :3].T + viewmat[:3, 3]).T
    k = camera.Ks[0]
    u, v = k[0, 0] * x / np.maximum(z, 1e-9) + k[0, 2], k[1, 1] * y / np.maximum(z, 1e-9) + k[1, 2]
    inside = (z > 0) & (u >= 0) & (v >= 0) & (u <= WIDTH) & (v <= HEIGHT)
    solid = g.means[g.opacities >= 0.5].astype(np.float64) @ viewmat[:3, :3].T + viewmat[:3, 3]
    tangents = np.array([WIDTH / 2 / k[0, 0], HEIGHT / 2 / k[1, 1]])
    ahead = solid[(solid[:, 2] > 0) & np.all(np.abs(solid[:, :2]) <= tangents * solid[:, 2:], axis=1)]
    nearest = float(np.linalg.norm(ahead, axis=1).min()) if len(ahead) else np.inf
    return {
        "box_inside": float(inside.mean()),
        "covered": float((alphas >= 0.5).mean()),
        "nearest": nearest / float(np.linalg.norm(high - low)) if np.isfinite(nearest) else -1.0,
    }


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--scenes", nargs="+", default=["builtin:two_rooms", "builtin:box_in_room"])
    parser.add_argument("--sheets", type=Path, default=None)
    options = parser.parse_args()
    found: dict[str, Any] = {}
    for scene in options.scenes:
        path, _, lod = scene.partition("@")
        source = load_source(path, int(lod) if lod else None)
        starts = plan_visit(source).starts or ()
        g = source.gaussians
        core = find_core(g)
        low, high = (core.detail_low, core.detail_high) if core.has_surroundings else (core.low, core.high)
        rows, images = [], []
        for start in starts:
            camera = cameras_from_poses([start.as_dict()], WIDTH, HEIGHT, FOV)
            drawn = rasterize(g, camera)
            rows.append(measure(g, camera, low, high, drawn.alphas[0]))
            images.append((255 * np.clip(drawn.images[0], 0, 1)).astype(np.uint8))
        found[source.name] = {"mode": starts[0].mode if starts else None, "views": rows}
        print(source.name, found[source.name], flush=True)
        if options.sheets is not None and images:
            options.sheets.mkdir(parents=True, exist_ok=True)
            Image.fromarray(np.concatenate(images, axis=1)).save(
                options.sheets / f"{source.name.replace('/', '_')}.png"
            )
    objects = [row["views"][0]["box_inside"] for row in found.values() if row["mode"] == "orbit" and row["views"]]
    without = sum(not row["views"] for row in found.values())
    figures = [
        {"name": "scenes without a first view", "target": 0, "reached": without, "unit": "", "better": "lower"},
        {"name": "least share of an object in its first view", "target": 0.98, "reached": min(objects, default=1.0),
         "unit": "", "better": "higher"},
    ]  # fmt: skip
    write_result(options.out, "Does a visit begin well?", figures, found)


if __name__ == "__main__":
    main()
