"""Do Gaussians far outside of a scene slow down the build of its visible sets?

A share of the Gaussians is copied and moved away from the middle of the scene by 1,000 times its extent. Navigable
space, grid, and all visible sets are made from both scenes in turn, by this process alone, so that the machine's load
disturbs both alike.

Given: a scene, and how many Gaussians fly away.
Measured: seconds with flyaways over seconds without, of finding the space and of the build.
Defaults chosen on: nothing; the rules of both stages were made without looking at this.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from _harness import add_arguments, realdata, write_result

from gsvis.io import load_scene
from gsvis.pvs.build import build_pvs
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.config import PvsConfig
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace

TARGET = 1.1


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--scene", default="nika_sh3", help="folder of scenes/, or a path")
    parser.add_argument("--lod", type=int, default=2)
    parser.add_argument("--share", type=float, default=2.5e-5, help="of the Gaussians that fly away, at least one")
    parser.add_argument("--times", type=float, default=1000.0, help="the extent of the scene")
    parser.add_argument("--cells", type=int, default=48, help="largest number")
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    path = Path(options.scene)
    g = load_scene(path if path.exists() else realdata() / "scenes" / options.scene / "lod-meta.json", lod=options.lod)
    scenes = {"without": g, "with": with_flyaways(g, options.share, options.times)}
    build(g, 2)  # compiles
    taken: dict[str, list[dict[str, Any]]] = {name: [] for name in scenes}
    for _ in range(options.repeats):
        for name, scene in scenes.items():
            taken[name].append(build(scene, options.cells))
    ratios = {
        stage: float(np.median([w[stage] / b[stage] for w, b in zip(taken["with"], taken["without"], strict=True)]))
        for stage in ("space", "sets", "all")
    }
    figures = [
        {"name": f"{stage}: time with flyaways over without", "target": TARGET, "reached": ratio, "unit": "x",
         "better": "lower"}
        for stage, ratio in ratios.items()
    ]  # fmt: skip
    details = {"gaussians": len(g), "flyaways": len(scenes["with"]) - len(g), "times": options.times, "runs": taken}
    write_result(options.out, "Do Gaussians far outside slow down the build of visible sets?", figures, details)


def with_flyaways(g: Gaussians, share: float, times: float) -> Gaussians:
    """Return the scene and copies of some Gaussians, moved out by `times` its extent (5% to 95%)."""
    rng = np.random.default_rng(0)
    low, high = np.quantile(g.means, [0.05, 0.95], axis=0)
    away = g[rng.choice(len(g), max(round(share * len(g)), 1), replace=False)]
    outward = away.means - (low + high) / 2
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    moved = away.means + times * float((high - low).max()) * outward
    parts = {name: getattr(away, name) for name in ("quats", "scales", "opacities", "sh0", "shN")}
    return Gaussians.concatenate([g, Gaussians(means=moved.astype(np.float32), **parts)])


def build(g: Gaussians, cells: int) -> dict[str, Any]:
    """Seconds of finding the space and of the build, with how many cells and viewpoints there were."""
    start = time.perf_counter()
    space = NavigableSpace.from_scene(g)
    middle = time.perf_counter()
    grid = CellGrid.over(space, max_cells=cells)
    with (
        tempfile.TemporaryDirectory() as folder,
        build_pvs(g, grid, space, Path(folder) / "sets.pvs", PvsConfig()) as store,
    ):
        end = time.perf_counter()
        return {
            "space": middle - start,
            "sets": end - middle,
            "all": end - start,
            "cells": len(grid),
            "voxel_size": space.voxel_size,
            "kind": space.kind.kind,
            "visible": float(store.visible_counts.mean()),
        }


if __name__ == "__main__":
    main()
