"""Do the visible sets of cells hold what fresh viewpoints see, and are they small?

Showroom LOD 3 in at least 200 cells. Ten cells are drawn at random; in each, viewpoints that building never used are
drawn, outside of everything solid. At each, six faces of 128 x 128 pixels measure how much of the light the cell's set
keeps (weighted recall), and one image of 480 x 360 pixels and 70 degrees, upright and looking at something, is drawn
from the set and from the full scene (PSNR, values clipped to [0, 1] as a display does). The ceiling is the PSNR of
the image drawn from exactly the Gaussians with a weight of at least tau in it. The dense union is what 27 more fresh
viewpoints of the cell see on faces of `--dense-size` pixels, 320 as the target says.

With `--store` a finished store is measured. Without, only the drawn cells of the grid are built, from the viewpoints
that they share with all others: their sets are those of a whole build.

Given: showroom LOD 3, its cells, sets built as `gsvis pvs` builds them.
Measured: recall at 128 pixels a face, size over a dense union at 320, PSNR at 480 x 360, from fresh viewpoints.
Defaults chosen on: showroom LOD 3, the scene that is measured too, at other viewpoints.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from _cells import add_cell_arguments, draw_cells, find_sets, store_of
from _harness import add_arguments, write_result

from gsvis.pvs.config import PvsConfig
from gsvis.pvs.quality import Quality, QualityConfig, measure_quality
from gsvis.pvs.store import VisibilityStore
from gsvis.pvs.viewpoints import CellViewpoints
from gsvis.scene.content import space_hash
from gsvis.scene.gaussians import Gaussians


def main() -> None:
    parser = add_cell_arguments(add_arguments(argparse.ArgumentParser(description=__doc__)))
    parser.add_argument("--store", type=Path, help="a store of the scene; without it the drawn cells are built")
    parser.add_argument("--method", default=PvsConfig.method, help="of building, without --store")
    parser.add_argument(
        "--size", type=int, default=PvsConfig.size, help="pixels of a face in building, without --store"
    )
    parser.add_argument("--viewpoints", type=int, default=4, help="fresh ones a cell")
    parser.add_argument("--dense", type=int, default=27, help="viewpoints of the dense union; 0 for none")
    parser.add_argument("--dense-size", type=int, default=320, help="pixels of the faces around these viewpoints")
    parser.add_argument("--rays", action="store_true", help="ask by ray casting, too, what is visible")
    options = parser.parse_args()
    drawn = draw_cells(options)
    g, space = drawn.scene, drawn.viewpoints.space
    config = QualityConfig(
        cells=options.cells,
        viewpoints=options.viewpoints,
        dense=options.dense,
        dense_size=options.dense_size,
        rays=options.rays,
        seed=options.seed,
    )
    with tempfile.TemporaryDirectory() as folder:
        seconds_to_build = None
        if options.store is None:
            start, build = time.perf_counter(), PvsConfig(method=options.method, size=options.size)
            store = store_of(drawn, find_sets(drawn, build), build, Path(folder) / "drawn.pvs")
            seconds_to_build = time.perf_counter() - start
        else:
            store = VisibilityStore.open(options.store, scene=g)
            if store.info.config.get("space") != space_hash(space):
                raise SystemExit(f"{options.store}: built in another navigable space than this scene has by default")
        with store:
            start = time.perf_counter()
            found = measure_quality(store, g, CellViewpoints(store.grid, space), config, progress=said)
            seconds = time.perf_counter() - start
            details = described(store, g, found)
    details |= {
        "cells_of_the_grid": len(drawn.grid),
        "store": "given" if options.store else f"only the {options.cells} drawn cells were built",
        "seconds_to_build": seconds_to_build,
        "seconds_to_measure": seconds,
    }
    write_result(
        options.out, "Do the visible sets hold what fresh viewpoints see, and are they small?", figures(found), details
    )


def figures(found: Quality) -> list[dict[str, Any]]:
    """Mean and worst of every figure, with its target where there is one."""
    listed = []
    for each in found.figures():
        pairs = (("mean", each.mean, each.targets[0]), (f"worst {each.worst_of}", each.worst, each.targets[1]))
        for label, reached, target in pairs:
            if reached is not None:
                name = f"{each.label}, {label}"
                better = each.better or "lower"
                listed.append({"name": name, "target": target, "reached": reached, "unit": each.unit, "better": better})
    return listed


def described(store: VisibilityStore, g: Gaussians, found: Quality) -> dict[str, Any]:
    """The store, and every measurement."""
    counts = store.visible_counts
    return {
        "gaussians": len(g),
        "cells": len(store),
        "cell_size": store.grid.cell_size,
        "build": dict(store.info.config),
        "viewpoints_a_cell": {"mean": float(store.viewpoints.mean()), "max": int(store.viewpoints.max())},
        "visible_share": {"mean": float(counts.mean()) / len(g), "max": int(counts.max()) / len(g)},
        "quality": found.as_dict(),
    }


def said(stage: str, done: int, total: int) -> None:
    if done == total or done % max(1, total // 20) == 0:
        print(f"{stage}: {done} of {total}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
