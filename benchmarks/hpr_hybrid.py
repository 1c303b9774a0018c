"""Does the hybrid find what ray casting finds from one viewpoint, in a tenth of the time, and what does each part find?

Showroom LOD 3, eyes drawn in its navigable space. Truth are ray-traced weights in all directions: six faces of
384 x 384 rays, and beside it rays to every Gaussian. The z-buffer, hidden point removal for Gaussians, hidden point
removal of the centers and the hybrid are measured against it: weighted recall is the weight kept over all weight,
largest weights of the Gaussians and their sums over the rays.

Given: showroom LOD 3, eyes drawn in navigable space.
Measured: weighted recall and precision against rays; time over that of the rays.
Defaults chosen on: showroom LOD 3, other eyes.
"""

from __future__ import annotations

import argparse
import sys
from typing import Any

import numpy as np
from _harness import add_arguments, measure, realdata, write_result
from paper.radius import calibrate_radius

from gsvis.hpr import Splats, hidden_point_removal, hybrid, look_around, visible_gaussians
from gsvis.io import load_scene
from gsvis.raycast import TAU, EllipsoidProxies, Tracer, visible_from
from gsvis.scene.cameras import Cameras
from gsvis.scene.navigable import NavigableSpace


def summed(tracer: Tracer, eye: np.ndarray, size: int) -> np.ndarray:
    """(N,) weights over the rays of six faces."""
    total = np.zeros(len(tracer.proxies.gaussians))
    for _, part in tracer.iter_contributions(*Cameras.cubemap(eye[None], size).rays()):
        total += np.bincount(part.gaussian_ids, part.weights, minlength=len(total))
    return total


def worth(ids: np.ndarray, truth: dict[str, np.ndarray]) -> dict[str, float]:
    found = {f"recall of {name}": float(weights[ids].sum() / weights.sum()) for name, weights in truth.items()}
    return {**found, "count": len(ids), "precision": float(np.mean(truth["largest weights, pixel rays"][ids] >= TAU))}


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--eyes", type=int, default=5)
    parser.add_argument("--size", type=int, default=384, help="rays and pixels along a side of the faces")
    parser.add_argument("--seed", type=int, default=2026)
    options = parser.parse_args()
    g = load_scene(realdata() / "scenes/showroom/lod-meta.json", lod=3)
    space = NavigableSpace.from_scene(g)
    eyes = space.sample_viewpoints(options.eyes, np.random.default_rng(options.seed))
    splats, tracer, size = Splats.from_gaussians(g), Tracer(EllipsoidProxies.from_scene(g)), options.size
    hybrid(g, splats, eyes[0], size=16)
    visible_gaussians(g, eyes[0])
    visible_from(tracer, eyes[:1], size=4)
    rows: list[dict[str, Any]] = []
    for eye in eyes:
        truth: dict[str, np.ndarray] = {}

        def cast(e: np.ndarray = eye, t: dict[str, np.ndarray] = truth) -> None:
            t["largest weights, pixel rays"] = visible_from(tracer, e[None], size=size)[0]

        def aim(e: np.ndarray = eye, t: dict[str, np.ndarray] = truth) -> None:
            t["largest weights, Gaussian rays"] = visible_from(tracer, e[None], sampling="gaussians")[0]

        seconds = {
            f"pixel rays, {size}": measure(cast, 1, 0).median,
            "Gaussian rays": measure(aim, 1, 0).median,
            "pixel rays, 128": measure(lambda e=eye: visible_from(tracer, e[None], size=128), 1, 0).median,
            "z-buffer": measure(lambda e=eye: look_around(splats, e, size=size, spent=TAU), 3, 0).median,
            "hybrid": measure(lambda e=eye: hybrid(g, splats, e, size=size), 3, 0).median,
            "hidden point removal": measure(lambda e=eye: visible_gaussians(g, e), 3, 0).median,
        }
        truth["summed weights, pixel rays"] = summed(tracer, eye, 128)
        radius = calibrate_radius(g.means, eye, truth["largest weights, Gaussian rays"], recall=0.99, steps=3).radius
        seen = look_around(splats, eye, size=size, spent=TAU)
        sets = {
            "z-buffer": seen.ids[seen.weights >= np.float32(TAU)],
            "hybrid": hybrid(g, splats, eye, size=size).ids,
            "hidden point removal": visible_gaussians(g, eye),
            "centers alone, radius for recall 0.99": hidden_point_removal(g.means, eye, radius),
        }
        rows.append({"eye": eye, "seconds": seconds, **{name: worth(ids, truth) for name, ids in sets.items()}})
        print(rows[-1], file=sys.stderr)

    def mean(way: str, figure: str) -> float:
        return float(np.mean([row[way][figure] for row in rows]))

    def ratio(way: str, base: str) -> float:
        return float(np.median([row["seconds"][way] / row["seconds"][base] for row in rows]))

    figures = [
        {"name": "hybrid: weight found, sum over the rays", "target": 0.99,
         "reached": mean("hybrid", "recall of summed weights, pixel rays"), "unit": "share", "better": "higher"},
        {"name": "hybrid: weight found, largest weights over pixel rays", "target": 0.99,
         "reached": mean("hybrid", "recall of largest weights, pixel rays"), "unit": "share", "better": "higher"},
        {"name": "hybrid: weight found, largest weights over Gaussian rays", "target": 0.99,
         "reached": mean("hybrid", "recall of largest weights, Gaussian rays"), "unit": "share", "better": "higher"},
        {"name": f"hybrid: time over casting as many rays ({size} x {size} a face)", "target": 0.1,
         "reached": ratio("hybrid", f"pixel rays, {size}"), "unit": "ratio", "better": "lower"},
        {"name": "hybrid: time over casting a ray to every Gaussian", "target": 0.1,
         "reached": ratio("hybrid", "Gaussian rays"), "unit": "ratio", "better": "lower"},
        {"name": "hybrid: time over casting 128 x 128 rays a face", "target": None,
         "reached": ratio("hybrid", "pixel rays, 128"), "unit": "ratio", "better": "lower"},
    ]  # fmt: skip
    for way in ("z-buffer", "hidden point removal", "centers alone, radius for recall 0.99", "hybrid"):
        for figure in ("recall of largest weights, Gaussian rays", "precision"):
            figures.append({"name": f"{way}: {figure}", "target": None, "reached": mean(way, figure), "unit": "share",
                            "better": "higher"})  # fmt: skip
    question = "Does the hybrid find what ray casting finds from one viewpoint, in a tenth of the time?"
    write_result(options.out, question, figures, {"gaussians": len(g), "size": size, "eyes": rows})


if __name__ == "__main__":
    main()
