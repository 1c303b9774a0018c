"""Do images from visible sets match the full scene, at the size of a display?

Cells are drawn, and their sets built, as in `pvs_quality.py`; the eyes and the directions of the images are the same.
Each image is drawn from the set and from the full scene, at 480 x 360 and at 1,920 x 1,080 pixels of 70 degrees, values
clipped to [0, 1] as a display does. The light that a set keeps is measured on faces of `--size` pixels.

Given: a scene, its cells, sets built as `gsvis pvs` builds them.
Measured: PSNR at 480 x 360 and 1,920 x 1,080, and weighted recall, from viewpoints that no build used.
Defaults chosen on: showroom LOD 3, at other cells and viewpoints.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from _cells import add_cell_arguments, draw_cells, find_sets, store_of
from _harness import add_arguments, write_result
from numpy.typing import NDArray

from gsvis.pvs.config import PvsConfig
from gsvis.pvs.store import VisibilityStore
from gsvis.pvs.viewpoints import CellViewpoints
from gsvis.render import psnr, rasterize, view_weights
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.solid import buried

QUESTION = "Do images from visible sets match the full scene, at the size of a display?"
SHAPES = ((480, 360), (1920, 1080))
FOV = 70.0
MOST = 100.0  # dB, of equal images
FRESH, AIMS = 0, 2  # random streams of `gsvis.pvs.quality`

F64 = NDArray[np.float64]
Rows = dict[str, list[list[float]]]


def main() -> None:
    parser = add_cell_arguments(add_arguments(argparse.ArgumentParser(description=__doc__)))
    parser.add_argument("--viewpoints", type=int, default=4, help="fresh ones a cell")
    parser.add_argument("--size", type=int, default=128, help="pixels of the faces that measure recall")
    options = parser.parse_args()
    drawn, config = draw_cells(options), PvsConfig()
    with (
        tempfile.TemporaryDirectory() as folder,
        store_of(drawn, find_sets(drawn, config), config, Path(folder) / "drawn.pvs") as store,
    ):
        found = measure(store, drawn.scene, CellViewpoints(store.grid, drawn.viewpoints.space), options)
        details = {"gaussians": len(drawn.scene), "cells": len(store), "cells_of_the_grid": len(drawn.grid)}
        details |= {"found": found, "build": dict(store.info.config), "inner": store.certificates.inner}
    write_result(options.out, QUESTION, list_figures(found), details)


def measure(store: VisibilityStore, g: Gaussians, viewpoints: CellViewpoints, options: argparse.Namespace) -> Rows:
    """Return the PSNR at each size and the light that is kept, for each eye of each cell."""
    rows: Rows = {**{f"{width}x{height}": [] for width, height in SHAPES}, "kept": []}
    for cell in range(len(store)):
        eyes = draw_eyes(g, viewpoints, cell, options)
        if eyes is None:
            continue
        ids = store.visible_ids(cell)
        for width, height in SHAPES:
            rng = np.random.default_rng([options.seed, cell, AIMS])
            cameras = viewpoints.space.cameras_at(eyes, rng, width=width, height=height, fov=FOV)
            images = [(draw(g, cameras[v]), draw(g[ids], cameras[v])) for v in range(len(eyes))]
            rows[f"{width}x{height}"].append([min(MOST, float(psnr(part, full))) for full, part in images])
        rows["kept"].append([weigh(g, ids, eye, options.size) for eye in eyes])
        print(f"cell {cell}: {rows['480x360'][-1]}", file=sys.stderr, flush=True)
    return rows


def draw_eyes(g: Gaussians, viewpoints: CellViewpoints, cell: int, options: argparse.Namespace) -> F64 | None:
    """Return the held-out viewpoints of a cell, the same as `measure_quality` draws."""
    rng, found = np.random.default_rng([options.seed, cell, FRESH]), np.zeros((0, 3))
    for _ in range(32):
        some = viewpoints.draw(cell, options.viewpoints, rng)
        found = np.concatenate([found, some[~buried(g, some)]])
        if len(found) >= options.viewpoints:
            return found[: options.viewpoints]
    return None


def draw(g: Gaussians, camera: Cameras) -> NDArray[np.float32]:
    return np.asarray(np.clip(rasterize(g, camera, backend="cpu").images[0], 0.0, 1.0), np.float32)


def weigh(g: Gaussians, ids: NDArray[np.int64], eye: F64, size: int) -> float:
    """Return the share of the light around an eye that a set keeps."""
    summed = view_weights(g, Cameras.cubemap(eye[None], size)).summed.sum(axis=0)
    return float(summed[ids].sum() / summed.sum()) if summed.any() else 1.0


def list_figures(found: Rows) -> list[dict[str, Any]]:
    figures = []
    for width, height in SHAPES:
        values = np.array(found[f"{width}x{height}"])
        for name, target, value in (("mean", 45.0, values.mean()), ("worst image", 40.0, values.min())):
            figures.append(row(f"image of {width} x {height} from the set, {name}", target, float(value), "dB"))
    kept = np.array(found["kept"])
    figures.append(row("light that the set keeps, mean", 0.999, float(kept.mean()), "share"))
    figures.append(row("light that the set keeps, worst cell", 0.995, float(kept.mean(axis=1).min()), "share"))
    return figures


def row(name: str, target: float, reached: float, unit: str) -> dict[str, Any]:
    return {"name": name, "target": target, "reached": reached, "unit": unit, "better": "higher"}


if __name__ == "__main__":
    main()
