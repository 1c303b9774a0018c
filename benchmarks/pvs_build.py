"""What does building visible sets cost against dense rays and dense cubemap images?

Showroom LOD 3, cells of a grid of 255 that lie together, because neighbors share viewpoints; both cores for everything:
building has two worker processes, timed from their start to the last certified cell (the details have the store's
writing, which is once a store and not once a cell); rays and images have two threads. Dense means 27 viewpoints drawn
in the cell, six faces of 128 x 128 rays or pixels each; some of the 27, of some of the cells, are timed and the rest is
extrapolated, the details say how many.

Given: showroom LOD 3, the 24 cells nearest to one drawn at random, the configuration of `gsvis pvs`.
Measured: time over dense rays and dense images in the same run.
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
from gsvis.jobs.workers import Workers
from gsvis.pvs.build import build_pvs
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.config import PvsConfig
from gsvis.pvs.viewpoints import CellViewpoints
from gsvis.raycast import EllipsoidProxies, Tracer, visible_from
from gsvis.render import view_weights
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
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


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--cells", type=int, default=24)
    parser.add_argument("--dense", type=int, default=6, help="of the cells, with dense rays and images")
    parser.add_argument("--timed", type=int, default=3, help=f"of the {DENSE} dense viewpoints")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    g = load_scene(realdata() / "scenes/showroom/lod-meta.json", lod=3)
    space = NavigableSpace.from_scene(g)
    grid, config = CellGrid.over(space, max_cells=256), PvsConfig()
    middle = grid.coords[int(np.random.default_rng(options.seed).integers(len(grid)))]
    apart = np.linalg.norm(grid.coords - middle, axis=1)
    cells = sorted(np.argsort(apart, kind="stable")[: options.cells].tolist())
    built(g, space, part_of(grid, cells[:2]), PvsConfig(size=16, rays=64, max_inner=0), 2)  # kernels
    build = built(g, space, part_of(grid, cells), config, 2)
    some = [cells[k] for k in np.linspace(0, len(cells) - 1, options.dense).astype(int)]
    rows = dense(g, CellViewpoints(grid, space), some, options.timed)
    rays, images = (sum(row[name] for row in rows) for name in ("dense_rays_s", "dense_raster_s"))
    a_cell = build["seconds"] / len(cells)
    figures = [
        {"name": "building over dense ray casting", "target": 0.1, "reached": a_cell / (rays / len(rows)),
         "unit": "ratio", "better": "lower"},
        {"name": "building over dense cubemap images", "target": 1 / 3, "reached": a_cell / (images / len(rows)),
         "unit": "ratio", "better": "lower"},
        {"name": "building, seconds a cell", "target": None, "reached": a_cell, "unit": "s",
         "better": "lower"},
        {"name": "building, viewpoints a cell", "target": None, "reached": build["viewpoints"] / len(cells),
         "unit": "viewpoints", "better": "lower"},
    ]  # fmt: skip
    write_result(
        options.out,
        "What does building visible sets cost against dense rays and dense images?",
        figures,
        {
            "grid": len(grid),
            "config": config.as_dict(),
            "timed": options.timed,
            "build": build,
            "dense": rows,
        },
    )


if __name__ == "__main__":
    main()
