"""What does one unit of each long stage cost on a large scene: a look, a view, a thousand rays, a step of learning?

A preparation is thousands of such units, so they say what a stage costs where a whole run takes an hour.

Given: copies of nika (`real_sizes.py`), SH 3; eyes in navigable space.
Measured: processor time of a unit, median over eyes or views, after one that is not counted. The results are hashed:
    a change that only makes a unit faster leaves the hash. `--before` takes the record of an earlier commit along.
Defaults chosen on: no scene.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from _harness import add_arguments, write_result
from real_sizes import MILLION, build

from gsvis.color import FitConfig, SrbfColors, fit_srbf
from gsvis.hpr import Splats
from gsvis.hpr.zbuffer import look_around
from gsvis.io.ply import load_ply
from gsvis.prepare.importance import importance_from_views
from gsvis.raycast import EllipsoidProxies, Tracer
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.view_sampling import ViewSampling
from gsvis.train.colors import LearnConfig, learn_colors
from gsvis.train.images import render_views

SIZES = (128, 512, 2048)  # pixels along a side of the faces of a look
RAYS = 4096
FITS = 8192
STEPS = 4


def main() -> None:
    """Build the scene, measure the units, write the record."""
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--size", type=float, default=0.6, metavar="M", help="millions of Gaussians")
    parser.add_argument("--eyes", type=int, default=5)
    parser.add_argument("--before", type=Path, help="record of this benchmark at an earlier commit")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as work:
        path = Path(work) / "copies.ply"
        build(path, round(options.size * MILLION))
        scene = load_ply(path)
    space = NavigableSpace.from_scene(scene)
    units = units_of(scene, space, options.eyes)
    found = {f"{options.size:g}M: {name}": measure(work) for name, work in units.items()}
    figures = [
        {"name": name, "target": None, "reached": cost, "unit": "ms", "better": "lower"}
        for name, (cost, _) in found.items()
    ]
    details: dict[str, Any] = {"hashes": {name: digest for name, (_, digest) in found.items()}}
    if options.before is not None:
        earlier = json.loads(options.before.read_text())
        details["before"] = {each["name"]: each["reached"] for each in earlier["figures"]}
        details["same"] = [name for name, digest in earlier["details"]["hashes"].items() if digest == found[name][1]]
    write_result(options.out, "What do units of stages cost?", figures, details)


def units_of(g: Gaussians, space: NavigableSpace, count: int) -> dict[str, list[Callable[[], Any]]]:
    """Return the units by name, each a list of calls: the first is not counted."""
    cameras = ViewSampling(count + 1, 320, 240, 60.0, stream=7).cameras(g, space)
    each = [cameras[c] for c in range(len(cameras))]
    eyes = cameras.viewpoints
    splats = Splats.from_gaussians(g)
    tracer = Tracer(EllipsoidProxies.from_scene(g))
    rng = np.random.default_rng(7)
    rays = rng.normal(size=(RAYS, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    few = fit_srbf(g[:: max(len(g) // 1024, 1)], None, FitConfig()).colors
    colors = few[np.arange(len(g)) % len(few)]
    units: dict[str, list[Callable[[], Any]]] = {
        f"a look on faces of {size} pixels": [
            lambda eye=eye, size=size: look_around(splats, eye, size=size, buffer=False).weights for eye in eyes
        ]
        for size in SIZES
    }
    units["a view weighed"] = [lambda view=view: importance_from_views(g, view).faces for view in each]
    units["a view rendered"] = [lambda view=view: render_views(g, view).images for view in each]
    units[f"{RAYS:,} rays"] = [
        lambda eye=eye: tracer.contributions(np.repeat(eye[None], RAYS, axis=0), rays).weights for eye in eyes
    ]
    units["8,192 fits, with 18,432 for the price"] = [lambda start=start: fit_some(g, start).base for start in range(3)]
    config = LearnConfig.for_renders(STEPS)
    units[f"{STEPS} steps of learning colors"] = [
        lambda view=view: learn_colors(g, colors, view, config).decays for view in each[:3]
    ]
    return units


def fit_some(g: Gaussians, start: int) -> SrbfColors:
    """Return the colors of 8,192 Gaussians, as if they were seen from everywhere and mattered by their size."""
    some = g[start :: max(len(g) // FITS, 1)][:FITS]
    size = some.opacities * np.sort(some.scales, axis=1)[:, 1:].prod(axis=1)
    return fit_srbf(some, None, FitConfig(), importance=size.astype(np.float64)).colors


def measure(work: list[Callable[[], Any]]) -> tuple[float, str]:
    """Return the median processor milliseconds of calls, without the first, and a hash of what they return."""
    digest = hashlib.sha256()
    taken = []
    for call in work:
        began = time.process_time()
        found = call()
        taken.append(1000.0 * (time.process_time() - began))
        digest.update(np.ascontiguousarray(found).tobytes())
    return round(median(taken[1:]), 1), digest.hexdigest()[:16]


if __name__ == "__main__":
    main()
