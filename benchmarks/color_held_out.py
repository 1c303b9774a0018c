"""What do long fits, more views and weights of directions change in views that the fit never saw?

The same scenes, the same mean number of terms, the same held-out views: those that `gsvis prepare` measures with (12)
and 24 of another random stream. Before: at most 8 terms a Gaussian, 96 views for the importance, all directions of a
set weighted the same. Then each change alone, added to the ones before it. Images of SRBF colors against those of SH;
"wire" rounds colors to records. A fit that loses its lobes when one is added is mended in all of them.

Given: scenes with SH, two terms a Gaussian on average, direction sets traced outward.
Measured: PSNR of held-out views, mean and worst; seconds of the fit and of the views before it.
Defaults chosen on: LOD 2 of nika and flowers. LOD 1 of both was not looked at before, but it is the same place.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from _harness import add_arguments, realdata, write_result
from numpy.typing import NDArray

from gsvis.color import FitConfig, SrbfColors, fit_srbf, quantize
from gsvis.color.evaluate import Evaluator
from gsvis.io import load_scene
from gsvis.prepare import PrepareConfig
from gsvis.prepare.importance import direction_weights, importance_from_views
from gsvis.raycast import EllipsoidProxies, Tracer
from gsvis.raycast.directions import trace_directions
from gsvis.render import psnr, rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.view_sampling import ViewSampling

SCENES = {"nika": "nika_sh3", "flowers": "flowers_sh2"}
STEPS = {
    "before": (96, False, 8),
    "24 terms": (96, False, 24),
    "24 terms, 256 views": (256, False, 24),
    "24 terms, 256 views, weights": (256, True, 24),
}
"""Views, whether directions are weighted, most terms."""


def draw(g: Gaussians, camera: Cameras, colors: NDArray[np.float32] | None = None) -> NDArray[np.float32]:
    """Return an image, clipped to [0, 1]."""
    return np.clip(rasterize(g, camera, colors=colors).images[0], 0.0, 1.0)


def compare(g: Gaussians, colors: SrbfColors, cameras: Cameras, truth: list[NDArray[np.float32]]) -> dict[str, float]:
    """Return mean and worst PSNR over views."""
    evaluator = Evaluator(colors)
    values = []
    for c, image in enumerate(truth):
        camera = cameras[c]
        seen = evaluator.colors(g.means, camera.viewpoints[0])
        values.append(min(100.0, float(psnr(draw(g, camera, seen), image))))
    return {"mean": float(np.mean(values)), "worst": float(np.min(values))}


def measure(name: str, lod: int) -> dict[str, object]:
    """Measure one scene after each step."""
    g = load_scene(realdata() / f"scenes/{SCENES[name]}/lod-meta.json", lod=lod)
    space = NavigableSpace.from_scene(g, up="-y")
    traced = trace_directions(Tracer(EllipsoidProxies.from_scene(g)), space, rays_per_face=1)
    held_out = {
        "views of prepare": PrepareConfig().fidelity_views.cameras(g, space),
        "24 further views": ViewSampling(24, seed=77, stream=5).cameras(g, space),
    }
    truth = {key: [draw(g, cameras[c]) for c in range(len(cameras))] for key, cameras in held_out.items()}
    found: dict[str, object] = {"gaussians": len(g)}
    for step, (views, is_weighted, most) in STEPS.items():
        began = time.perf_counter()
        seen = importance_from_views(g, ViewSampling(views).cameras(g, space))
        looked = time.perf_counter()
        sets = traced | seen.sets
        given = direction_weights(sets, seen.shares) if is_weighted else sets
        fit = fit_srbf(g, given, FitConfig(max_terms=most), importance=seen.importance)
        ended = time.perf_counter()
        kinds = {"exact": fit.colors, "wire": quantize(fit.colors, "wire").dequantize()}
        found[step] = {
            "terms": fit.colors.num_terms / len(g),
            "view_seconds": looked - began,
            "fit_seconds": ended - looked,
            **{
                f"{kind}, {key}": compare(g, colors, cameras, truth[key])
                for kind, colors in kinds.items()
                for key, cameras in held_out.items()
            },
        }
        print(name, lod, step, found[step], flush=True)
    return found


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    usual = ["nika:2", "flowers:2", "nika:1", "flowers:1"]
    parser.add_argument("--scenes", nargs="+", default=usual, metavar="NAME:LOD")
    arguments = parser.parse_args()
    found = {}
    for scene in arguments.scenes:
        name, lod = scene.split(":")
        found[f"{name} LOD {lod}"] = measure(name, int(lod))
    figures = []
    for scene, steps in found.items():
        for step in ("before", list(STEPS)[-1]):
            for spread in ("mean", "worst"):
                row = steps[step]
                assert isinstance(row, dict)
                figures.append(
                    {
                        "name": f"{scene}, {step}: {spread} PSNR of 24 further views, colors as on the wire",
                        "target": None,
                        "reached": row["wire, 24 further views"][spread],
                        "unit": "dB",
                        "better": "higher",
                    }
                )
    write_result(arguments.out, "What do long fits, more views and weights of directions change?", figures, found)


if __name__ == "__main__":
    main()
