"""How far apart are the rasterizer's weights (EWA) and those along exact rays?

Showroom LOD 3 and nika LOD 0, cameras sampled in navigable space: of the weight one of them sees, how much belongs to
Gaussians that the other also calls visible (weighted recall, both ways), and how far apart the images are.

Given: showroom LOD 3 and nika LOD 0, cameras drawn in navigable space.
Measured: share of the weight that both call visible; PSNR between them.
Defaults chosen on: no scene.
"""

from __future__ import annotations

import argparse
import sys

import numpy as np
from _harness import add_arguments, realdata, write_result

from gsvis.io import load_scene
from gsvis.raycast import TAU, EllipsoidProxies, Tracer, ray_image, visible_in
from gsvis.render import rasterize, view_weights
from gsvis.scene.navigable import NavigableSpace

SCENES = (("showroom", 3), ("nika_sh3", 0))


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--views", type=int, default=8)
    options = parser.parse_args()
    figures, details = [], {}
    for name, lod in SCENES:
        g = load_scene(realdata() / "scenes" / name / "lod-meta.json", lod=lod)
        space = NavigableSpace.from_scene(g)
        cameras = space.sample_cameras(options.views, np.random.default_rng(0), width=256, height=192, fov=60)
        tracer = Tracer(EllipsoidProxies.from_scene(g))
        by_rays, by_raster = visible_in(tracer, cameras), view_weights(g, cameras).largest
        rows = []
        for c in range(len(cameras)):
            a, b = by_rays[c], by_raster[c]
            image = rasterize(g, cameras[c]).images[0]
            error = np.mean((np.clip(image, 0, 1) - np.clip(ray_image(tracer, cameras[c]), 0, 1)) ** 2)
            rows.append({"rays_kept_by_raster": a[b >= TAU].sum() / a.sum(),
                         "raster_kept_by_rays": b[a >= TAU].sum() / b.sum(),
                         "psnr": -10 * np.log10(error), "visible_rays": int((a >= TAU).sum()),
                         "visible_raster": int((b >= TAU).sum())})  # fmt: skip
            print(name, rows[-1], file=sys.stderr)
        details[f"{name}:{lod}"] = rows
        for key, label in (("rays_kept_by_raster", "ray-traced weight that the rasterized set keeps"),
                          ("raster_kept_by_rays", "rasterized weight that the ray-traced set keeps")):  # fmt: skip
            mean = float(np.mean([row[key] for row in rows]))
            figures.append({"name": f"{name} LOD {lod}: {label}", "target": None, "reached": mean, "unit": "share",
                            "better": "higher"})  # fmt: skip
        psnr = float(np.mean([row["psnr"] for row in rows]))
        figures.append({"name": f"{name} LOD {lod}: image by rays against image by rasterizer", "target": None,
                        "reached": psnr, "unit": "dB", "better": "higher"})  # fmt: skip
    write_result(options.out, "How far apart are rasterized and ray-traced weights?", figures, details)


if __name__ == "__main__":
    main()
