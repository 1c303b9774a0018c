"""What do repairs of visible sets cost where a scene is large, and what is it worth to take what was seen faintly?

Sets of a few cells are found twice from the same looks: repaired by more looks alone, and by first taking what the
viewpoints saw too faintly (design note 125). Neither takes a look twice.

Given: one level; copies of nika, as many as needed, turned and jittered (`real_sizes.py`), and guitar.
Measured: processor seconds of a cell, size of its set, its bound, and the light that it misses on 16,384 rays of a seed
    of their own.
Defaults chosen on: copies of nika, four other cells.
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
from real_sizes import MILLION, build

from gsvis.io.sources import load_source
from gsvis.pvs.cell_view import Finder
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.certificate import CertificateConfig, Certifier
from gsvis.pvs.config import PvsConfig
from gsvis.pvs.sightings import FaintOnes
from gsvis.pvs.viewpoints import CellViewpoints, SharedViewpoints
from gsvis.raycast import EllipsoidProxies, Tracer
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.scene.navigable import NavigableSpace

MOST_CELLS = 256
FRESH = CertificateConfig(limit=0.0, rays=16_384, seed=77, sparse=8)
WAYS = {"looks alone": lambda _self, _missed: False, "faint first": FaintOnes.pay}


def main() -> None:
    """Find the sets of some cells in both ways, scene by scene."""
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--size", type=float, default=2.0, metavar="M", help="millions of Gaussians of the copies")
    parser.add_argument("--cells", type=int, default=2, help="cells of each scene, drawn at random")
    parser.add_argument("--seed", type=int, default=5)
    options = parser.parse_args()
    figures: list[dict[str, Any]] = []
    details: dict[str, Any] = {}
    guitar = load_source(str(realdata() / "scenes" / "formats" / "guitar.compressed.ply"), None).gaussians
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "copies.ply"
        build(path, round(options.size * MILLION))
        copies = load_source(str(path), None).gaussians
    for name, scene in (("guitar", guitar), (f"copies of nika, {options.size:g}M", copies)):
        rows = compare(scene, options.cells, options.seed)
        details[name] = {"gaussians": len(scene), "cells": rows}
        for way in WAYS:
            for key, what, unit in (
                ("cpu_s", "processor time of a cell", "s"),
                ("bound", "bound of the missed light", ""),
                ("missed", "missed on fresh rays", ""),
                ("gaussians", "size of a set", ""),
            ):
                reached = float(np.mean([row[way][key] for row in rows]))
                figure = {"name": f"{name}, {way}: {what}", "target": None, "reached": reached}
                figures.append({**figure, "unit": unit, "better": "lower"})
    write_result(options.out, "What do repairs of visible sets cost in large scenes?", figures, details)


def compare(scene: Gaussians, count: int, seed: int) -> list[dict[str, Any]]:
    """Return the figures of some cells, by way."""
    space = NavigableSpace.from_scene(scene)
    grid = CellGrid.over(space, max_cells=MOST_CELLS)
    viewpoints = CellViewpoints(grid, space)
    shared = SharedViewpoints(viewpoints)
    finder = Finder(Levels.single(scene), PvsConfig())
    finder.warm()
    judge = Certifier(Tracer(EllipsoidProxies.from_scene(scene)))
    rows = []
    for cell in np.random.default_rng(seed).choice(len(grid), min(count, len(grid)), replace=False).tolist():
        around = shared.of_cell(cell).tolist()
        sightings = [finder.look(shared.points[k], fine=bool(shared.fine[k])) for k in around]
        voxels = viewpoints.voxels(cell)
        row: dict[str, Any] = {"cell": cell}
        for way, pay in WAYS.items():
            FaintOnes.pay = pay  # type: ignore[method-assign, assignment]
            began = time.process_time()
            view = finder.find_cell(voxels, sightings)
            taken = time.process_time() - began
            fresh = judge.certify(voxels, view.ids, FRESH)
            row[way] = {
                "cpu_s": round(taken, 3),
                "gaussians": len(view.ids),
                "looks": view.figures.inner,
                "bound": view.figures.bound,
                "missed": None if fresh is None else fresh.missed,
            }
        rows.append(row)
        print(row, file=sys.stderr, flush=True)
    return rows


if __name__ == "__main__":
    main()
