"""How long does a whole build of visible sets take, in cubemaps of the rasterizer?

All cells of a scene, as `gsvis pvs` builds them: its navigable space, its grid, its default configuration, worker
processes. The ruler is the median of forward cubemaps, 6 x 320^2 pixels with all threads of one process, by the
rasterizer of the same checkout; results up to 0.3.0 have the rasterizer of commit 70806c2 as ruler, so they do not
compare. The same eyes are drawn before and after the build; where the two medians differ, the load of the machine did
too. The ratio is taken with the median of both together. Kernels are compiled before, on a small scene.

A stage lasts from the end of the one before to its own end; "viewpoints" includes the plan of the build, and "cells"
starting its workers. Memory is the proportional set size (PSS) of all processes together, this one with the ruler in it
too, once a second; shorter peaks may go unseen.

Given: a folder of levels (`--levels`, made by `gsvis levels`), or a scene without levels (`--scene`, `--lod`).
Measured: time over as many cubemaps as there are cells; what the certificates of the store say; looks; peak memory.
Defaults chosen on: showroom LOD 3 with three levels, for which the target is set.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from _harness import Timing, add_arguments, measure, need, realdata, write_result
from _memory import Peak, watch_memory
from numba import get_num_threads
from numpy.typing import NDArray

from gsvis.io.sources import load_source
from gsvis.jobs.workers import Workers
from gsvis.pvs.build import build_pvs
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.config import PvsConfig
from gsvis.pvs.store import VisibilityStore
from gsvis.pvs.viewpoints import CellViewpoints, SharedViewpoints
from gsvis.render import rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.procedural import two_rooms
from gsvis.scene.solid import buried
from gsvis.scene.source import Source

QUESTION = "How long does a whole build of visible sets take, in cubemaps of the rasterizer?"
SIZE = 320
EVERY = 1.0  # seconds between samples of the memory
STAGES = ("viewpoints", "cells", "check", "store")
QUANTILES = (0.0, 0.25, 0.5, 0.75, 0.95, 1.0)

F64 = NDArray[np.float64]
Row = tuple[str, float | None, float, str, str]


@dataclass
class Built:
    """What a build took and what its store says."""

    stages: dict[str, float] = field(default_factory=lambda: dict.fromkeys(STAGES, 0.0))
    whole: float = 0.0
    peak: Peak = field(default_factory=Peak)
    store: dict[str, Any] = field(default_factory=dict)
    rows: list[Row] = field(default_factory=list)


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--levels", help="folder that `gsvis levels` made")
    parser.add_argument("--scene", help="folder of scenes/, a path, or builtin:NAME; without levels")
    parser.add_argument("--lod", type=int, default=3, help="of --scene, where it is one of scenes/")
    parser.add_argument("--max-cells", type=int, default=256, help="of the grid")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--cubemaps", type=int, default=8, help="eyes of the ruler, before and again after the build")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    need(options.levels or options.scene, "--levels, a folder that `gsvis levels` made, or --scene")
    source = read_source(options)
    space = NavigableSpace.from_scene(source.gaussians)
    grid = CellGrid.over(space, max_cells=options.max_cells)
    viewpoints = CellViewpoints(grid, space)
    shared = len(SharedViewpoints(viewpoints))
    print(f"{len(source.union):,} Gaussians, {len(grid)} cells, {shared} shared viewpoints", file=sys.stderr)
    eyes = choose_eyes(source.gaussians, viewpoints, options.cubemaps, options.seed)
    compile_kernels(source.levels is not None, options.workers)
    load = [os.getloadavg()[0]]
    before = draw_cubemaps(source.gaussians, eyes)
    built = build(source, viewpoints, options.workers)
    after = draw_cubemaps(source.gaussians, eyes)
    load.append(os.getloadavg()[0])
    cubemap = Timing(before.samples + after.samples).median
    cells, looked = len(grid), built.stages["viewpoints"] + built.stages["cells"]
    target = 1.2 if source.levels is not None else None
    rows: list[Row] = [
        ("looks and cells over as many cubemaps", target, looked / (cells * cubemap), "ratio", "lower"),
        ("whole build over as many cubemaps", None, built.whole / (cells * cubemap), "ratio", "lower"),
        ("looks and cells, seconds a cell", None, looked / cells, "s", "lower"),
        ("one cubemap before the build", None, before.median, "s", "lower"),
        ("one cubemap after the build", None, after.median, "s", "lower"),
        ("shared viewpoints a cell", None, shared / cells, "viewpoints", "lower"),
        *built.rows,
        ("peak memory of all processes", None, built.peak.bytes / 1e9, "GB", "lower"),
    ]
    write_result(
        options.out,
        QUESTION,
        [dict(zip(("name", "target", "reached", "unit", "better"), row, strict=True)) for row in rows],
        {
            "scene": source.name,
            "gaussians": len(source.union),
            "levels": None if source.levels is None else source.levels.counts,
            "cells": cells,
            "shared_viewpoints": shared,
            "config": PvsConfig().as_dict(),
            "workers": options.workers,
            "threads": get_num_threads(),
            "load_before_and_after": load,
            "cubemaps_before": before,
            "cubemaps_after": after,
            "stages_s": built.stages,
            "whole_s": built.whole,
            "peak": {"bytes": built.peak.bytes, "at_s": built.peak.at, "processes": built.peak.processes},
            "store": built.store,
        },
    )


def read_source(options: argparse.Namespace) -> Source:
    if options.levels:
        return load_source(options.levels, None)
    if options.scene.startswith("builtin:") or Path(options.scene).is_file():
        return load_source(options.scene, None)
    return load_source(str(realdata() / "scenes" / options.scene / "lod-meta.json"), options.lod)


def choose_eyes(g: Gaussians, viewpoints: CellViewpoints, count: int, seed: int) -> F64:
    """Random free eyes (E, 3) that lie inside nothing solid, of cells drawn at random."""
    rng = np.random.default_rng(seed)
    cells = rng.integers(len(viewpoints.grid), size=8 * count)
    eyes = np.concatenate([viewpoints.draw(int(cell), 1, rng) for cell in cells])
    eyes = eyes[~buried(g, eyes)][:count]
    if len(eyes) == 0:
        raise SystemExit("every eye that was drawn lies inside something solid; try another --seed")
    return eyes


def compile_kernels(with_levels: bool, workers: int) -> None:
    """Build sets of a small scene, so that all kernels are on disk when workers need them."""
    made = two_rooms()
    odd = np.arange(len(made.gaussians)) % 2
    g = Levels(made.gaussians, odd, np.ones_like(odd), ("low", "high")) if with_levels else made.gaussians
    grid = CellGrid.over(made.navigable, max_cells=4)
    with tempfile.TemporaryDirectory() as folder:
        quick = PvsConfig(size=32, rays=512, max_inner=1)
        path = Path(folder) / "small.pvs"
        build_pvs(g, grid, made.navigable, path, quick, workers=Workers(workers)).close()


def draw_cubemaps(g: Gaussians, eyes: F64) -> Timing:
    """Time one forward cubemap from each eye."""
    faces = [Cameras.cubemap(eye[None], SIZE) for eye in eyes]
    each = iter([faces[0], *faces])  # the first does not count
    return measure(lambda: rasterize(g, next(each), backend="cpu"), repeats=len(faces))


def build(source: Source, viewpoints: CellViewpoints, workers: int) -> Built:
    """Build all sets as `gsvis pvs` does, and note time and memory."""
    built = Built()
    with tempfile.TemporaryDirectory() as folder, watch_memory(EVERY) as built.peak:
        began = last = time.perf_counter()
        stage = STAGES[0]

        def note(at: str, done: int, total: int) -> None:
            nonlocal last, stage
            now, stage = time.perf_counter(), at
            built.stages[at] += now - last
            last = now
            if done == total or done % 16 == 0:
                print(f"{at} {done} of {total}, {now - began:.0f} s", file=sys.stderr, flush=True)

        path, grid = Path(folder) / "whole.pvs", viewpoints.grid
        pool = Workers(workers)
        with build_pvs(source.whole, grid, viewpoints.space, path, workers=pool, progress=note) as store:
            ended = time.perf_counter()
            built.stages[stage] += ended - last
            built.whole = ended - began
            built.rows, built.store = read_store(store)
    return built


def read_store(store: VisibilityStore) -> tuple[list[Row], dict[str, Any]]:
    """Return the figures of a store and of its certificates, and details."""
    found, visible, sizes = store.certificates, store.visible_counts, store.sizes()
    known = found.known
    above = np.count_nonzero(found.bound > PvsConfig.limit)
    rows: list[Row] = [
        ("inner viewpoints a cell", None, float(found.inner.mean()), "viewpoints", "lower"),
        ("rays a cell", None, float(found.rays.mean()), "rays", "lower"),
        ("visible Gaussians of a cell, mean", None, float(visible.mean()), "Gaussians", "lower"),
        ("cells above the limit of the bound", None, 100.0 * float(above) / len(store), "%", "lower"),
    ]
    details: dict[str, Any] = {
        "cells_without_a_certificate": int(np.count_nonzero(~known)),
        "cells_without_a_free_viewpoint": int(np.count_nonzero(store.viewpoints == 0)),
        "traced_twice": store.info.config.get("traced_twice"),
        "bytes": sizes["file"],
        "quantiles": QUANTILES,
        "visible": np.quantile(visible, QUANTILES),
        "inner": np.quantile(found.inner, QUANTILES),
        "rays": np.quantile(found.rays, QUANTILES),
    }
    if known.any():
        for name, words in (("missed", "missed light"), ("bound", "bound of the missed light")):
            shares = 100.0 * getattr(found, name)[known]
            rows.append((f"{words}, mean of the cells", None, float(shares.mean()), "%", "lower"))
            rows.append((f"{words}, worst cell", None, float(shares.max()), "%", "lower"))
        for name in ("missed", "bound", "tile"):
            details[name] = np.quantile(getattr(found, name)[known], QUANTILES)
    return rows, details


if __name__ == "__main__":
    main()
