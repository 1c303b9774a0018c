"""What does building visible sets cost against dense rays and dense cubemap images, and how does it grow?

Showroom LOD 3, ten cells of a grid of 255, both cores for everything: building has two worker processes, timed from
their start to the last cell (the details have the store's writing, which is once a store and not once a cell); rays
and images have two threads. Dense means 27 viewpoints drawn in
the cell, six faces of 128 x 128 rays or pixels each; some of the 27 are timed and the rest is extrapolated, the
details say how many. Growth: with the number of Gaussians (random parts of LOD 3, then LOD 2), with cells, and with
worker processes.

Given: showroom LOD 3, ten cells of 255, the configuration of `gsvis pvs`.
Measured: time over dense rays and dense images in the same run; growth.
Defaults chosen on: showroom LOD 3, the scene that is measured too.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from _harness import add_arguments, realdata, write_result

from gsvis.io import load_scene
from gsvis.pvs.build import build_pvs
from gsvis.pvs.cell_view import Finder
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.config import PvsConfig
from gsvis.pvs.viewpoints import CellViewpoints, SharedViewpoints
from gsvis.pvs.workers import Workers
from gsvis.raycast import EllipsoidProxies, Tracer, visible_from
from gsvis.render import view_weights
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.scene.navigable import NavigableSpace

DENSE, SIZE = 27, 128


def clock(fn: Any) -> float:
    began = time.perf_counter()
    fn()
    return time.perf_counter() - began


def dense(g: Gaussians, places: CellViewpoints, cells: list[int], timed: int) -> list[dict[str, Any]]:
    """Seconds of dense images and dense rays of each cell."""
    tracer = Tracer(EllipsoidProxies.from_scene(g))
    rng, rows = np.random.default_rng(1), []
    visible_from(tracer, places.draw(cells[0], 1, rng), size=8)
    view_weights(g, Cameras.cubemap(places.draw(cells[0], 1, rng), 8))
    for cell in cells:
        eyes = places.draw(cell, timed, rng)
        raster = clock(lambda e=eyes: [view_weights(g, Cameras.cubemap(eye[None], SIZE)) for eye in e])
        rays = clock(lambda e=eyes: [visible_from(tracer, eye[None], size=SIZE) for eye in e])
        rows.append({"cell": cell, "dense_raster_s": raster * DENSE / timed, "dense_rays_s": rays * DENSE / timed})
        print(rows[-1], file=sys.stderr)
    return rows


def built(g: Gaussians, space: NavigableSpace, grid: CellGrid, config: PvsConfig, workers: int) -> dict[str, Any]:
    """Seconds from starting the processes until all cells are looked from, and until the store is on disk."""
    written: list[float] = []

    def note(stage: str, done: int, total: int) -> None:
        if stage == "store" and done == 0:
            written.append(time.perf_counter())

    with tempfile.TemporaryDirectory() as place:
        began = time.perf_counter()
        path = Path(place) / "x.pvs"
        with build_pvs(g, grid, space, path, config, workers=Workers(workers), progress=note) as store:
            whole = time.perf_counter() - began
            looked = int(store.viewpoints.sum())
    taken = written[0] - began
    row = {"cells": len(grid), "workers": workers, "seconds": taken, "with_store_s": whole, "viewpoints": looked}
    print(row, file=sys.stderr)
    return row


def part_of(grid: CellGrid, cells: Any) -> CellGrid:
    return CellGrid(grid.origin, grid.cell_size, grid.shape, grid.coords[np.sort(cells)], grid.up)


def growth(folder: Path, g: Gaussians, space: NavigableSpace, grid: CellGrid, config: PvsConfig) -> dict[str, Any]:
    places, rng = CellViewpoints(grid, space), np.random.default_rng(2)
    some, shared = sorted(rng.choice(len(grid), 3, replace=False).tolist()), SharedViewpoints(places)
    eyes = shared.points[np.unique(np.concatenate([shared.of_cell(cell) for cell in some]))]
    by_count = []
    finer = load_scene(folder / "scenes/showroom/lod-meta.json", lod=2)
    parts = [g[np.sort(rng.permutation(len(g))[: len(g) // part])] for part in (4, 2)]
    for scene in (*parts, g, finer):
        finder = Finder(Levels.single(scene), config)
        finder.warm()
        taken = clock(lambda f=finder: [f.look(eye) for eye in eyes])
        by_count.append({"gaussians": len(scene), "seconds_a_viewpoint": taken / len(eyes)})
        print(by_count[-1], file=sys.stderr)
    middle = grid.coords[len(grid) // 2]
    nearest = np.argsort(np.linalg.norm(grid.coords - middle, axis=1), kind="stable")
    by_cells, by_workers = [], []
    for count, workers in ((4, 1), (8, 1), (16, 1), (16, 2)):
        row = built(g, space, part_of(grid, nearest[:count]), config, workers)
        (by_workers if workers > 1 else by_cells).append(row)
    return {"gaussians": by_count, "cells": by_cells, "workers": [by_cells[-1], *by_workers]}


def plot(path: Path, found: dict[str, Any]) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(11, 3.2), layout="constrained")
    lines = (
        ([r["gaussians"] / 1e6 for r in found["gaussians"]], [r["seconds_a_viewpoint"] for r in found["gaussians"]],
         "million Gaussians", "seconds a viewpoint"),
        ([r["cells"] for r in found["cells"]], [r["seconds"] for r in found["cells"]], "cells", "seconds"),
        ([r["workers"] for r in found["workers"]], [r["seconds"] for r in found["workers"]],
         "worker processes, 16 cells", "seconds"),
    )  # fmt: skip
    for axis, (x, y, across, up) in zip(axes, lines, strict=True):
        axis.plot(x, y, "o-", color="#2a6fb0")
        axis.set(xlabel=across, ylabel=up, ylim=(0, None), xlim=(0, None))
        axis.spines[["top", "right"]].set_visible(False)
    axes[2].set_xticks([1, 2])
    figure.suptitle("Building visible sets of showroom LOD 3, hybrid")
    figure.savefig(path, dpi=130)


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--cells", type=int, default=10)
    parser.add_argument("--timed", type=int, default=3, help=f"of the {DENSE} dense viewpoints")
    parser.add_argument("--no-growth", action="store_true")
    parser.add_argument("--plot", type=Path, help="draw the growth there as PNG")
    options = parser.parse_args()
    folder = realdata()
    g = load_scene(folder / "scenes/showroom/lod-meta.json", lod=3)
    space = NavigableSpace.from_scene(g)
    grid, config = CellGrid.over(space, max_cells=256), PvsConfig()
    cells = sorted(np.random.default_rng(0).choice(len(grid), options.cells, replace=False).tolist())
    built(g, space, part_of(grid, cells[:2]), PvsConfig(size=16, rays=256, max_inner=1), 2)  # kernels
    build = built(g, space, part_of(grid, cells), config, 2)
    rows = dense(g, CellViewpoints(grid, space), cells, options.timed)
    found = {} if options.no_growth else growth(folder, g, space, grid, config)
    if found and options.plot:
        plot(options.plot, found)
    rays, images = (sum(row[name] for row in rows) for name in ("dense_rays_s", "dense_raster_s"))
    figures = [
        {"name": "building over dense ray casting", "target": 0.1, "reached": build["seconds"] / rays,
         "unit": "ratio", "better": "lower"},
        {"name": "building over dense cubemap images", "target": 1 / 3, "reached": build["seconds"] / images,
         "unit": "ratio", "better": "lower"},
        {"name": "building, seconds a cell", "target": None, "reached": build["seconds"] / len(rows), "unit": "s",
         "better": "lower"},
        {"name": "building, viewpoints a cell", "target": None, "reached": build["viewpoints"] / len(rows),
         "unit": "viewpoints", "better": "lower"},
    ]  # fmt: skip
    write_result(
        options.out,
        "What does building visible sets cost against dense rays and dense images, and how does it grow?",
        figures,
        {
            "grid": len(grid),
            "config": config.as_dict(),
            "timed": options.timed,
            "build": build,
            "dense": rows,
            "growth": found,
        },
    )


if __name__ == "__main__":
    main()
