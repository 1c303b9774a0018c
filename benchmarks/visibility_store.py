"""How small is a store of visible sets, and how quick are its queries?

Takes a store (`--store FILE`, as `gsvis pvs` writes it), or makes one of showroom LOD 3: cubemap views from `--eyes`
viewpoints in each of `--cells` adjacent cells, the rest of the grid left out. Bits count the whole file but weight
classes and direction sets. A cold query finds no decoded set; a warm one finds them in the cache. The peer is one
roaring bitmap a cell in scene order, with runs where they pay.

Given: a store of showroom LOD 3.
Measured: bits for each (cell, visible Gaussian); seconds of queries.
Defaults chosen on: showroom LOD 3 and shuffled copies, the store that is measured too.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from _harness import add_arguments, realdata, write_result
from pyroaring import BitMap

from gsvis.io import load_scene
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.store import CellSet, StoreInfo, VisibilityStore, write_store
from gsvis.raycast.directions import seen_directions
from gsvis.render import view_weights
from gsvis.scene.cameras import Cameras
from gsvis.scene.content import scene_hash
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace

EDGES = np.array([1 / 255, 1 / 64, 1 / 16, 1 / 4])


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--store", type=Path, help="a store to measure")
    parser.add_argument("--cells", type=int, default=24, help="cells to build without --store")
    parser.add_argument("--eyes", type=int, default=2, help="viewpoints in each of them")
    parser.add_argument("--queries", type=int, default=100)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = options.store or build(Path(folder) / "built.pvs", options.cells, options.eyes)
        with VisibilityStore.open(path) as store:
            figures, details = measured(store, path, options.queries)
    write_result(options.out, "How small is a store of visible sets, and how quick are its queries?", figures, details)


def measured(store: VisibilityStore, path: Path, queries: int) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    rng = np.random.default_rng(0)
    cells = rng.integers(0, len(store), queries).tolist()
    sizes, opened = store.sizes(), []
    for _ in range(7):
        start = time.perf_counter()
        VisibilityStore.open(path).close()
        opened.append(1e3 * (time.perf_counter() - start))
    start = time.perf_counter()
    store.visible(0)  # reads the stored order
    first = 1e3 * (time.perf_counter() - start)
    store.classes(0), store.distance_to_visibility(0)
    asked: dict[str, tuple[Callable[[int], object], Iterable[int]]] = {
        "visible": (store.visible, cells),
        "visible_ids": (store.visible_ids, cells),
        "classes": (store.classes, cells),
        "distance_to_visibility": (store.distance_to_visibility, cells[:20]),
    }
    times: dict[str, dict[str, float]] = {}
    for name, (ask, which) in asked.items():
        cold = [milliseconds(ask, cell, store) for cell in which]
        for cell in which:
            ask(cell)
        warm = [milliseconds(ask, cell) for cell in which]
        times[name] = {
            "cold_median": float(np.median(cold)), "cold_worst": max(cold),
            "warm_median": float(np.median(warm)), "warm_worst": max(warm),
        }  # fmt: skip
    pairs = int(store.visible_counts.sum())
    some = [store.visible(cell) for cell in sorted(set(cells))]
    for bitmap in some:
        bitmap.run_optimize()
    roaring = 8 * sum(len(s.serialize()) for s in some) / max(1, sum(len(s) for s in some))
    reading = float(np.median([milliseconds(BitMap.deserialize, s.serialize()) for s in some]))
    figures = [
        figure("bits for each (cell, visible Gaussian), without classes", 3.0, sizes["bits_per_pair"], "bits"),
        figure("bits of its weight class", None, sizes["class_bits_per_pair"], "bits"),
        figure("visible, cold", 1.0, times["visible"]["cold_median"], "ms"),
        figure("visible, warm", 1.0, times["visible"]["warm_median"], "ms"),
        figure("distance_to_visibility, cold", 50.0, times["distance_to_visibility"]["cold_median"], "ms"),
        figure("distance_to_visibility, warm", 50.0, times["distance_to_visibility"]["warm_median"], "ms"),
        figure("size over one roaring bitmap a cell", None, sizes["bits_per_pair"] / roaring, "ratio"),
        figure("open", None, float(np.median(opened)), "ms"),
    ]
    details = {
        "gaussians": store.gaussians, "cells": len(store), "pairs": pairs, "config": dict(store.info.config),
        "visible_share": pairs / max(1, len(store) * store.gaussians), "aim_bits": 1.5, "sizes": sizes,
        "queries_ms": times, "first_query_ms": first, "roaring_bits": roaring, "roaring_deserialize_ms": reading,
    }  # fmt: skip
    return figures, details


def figure(name: str, target: float | None, reached: float, unit: str) -> dict[str, Any]:
    return {"name": name, "target": target, "reached": reached, "unit": unit, "better": "lower"}


def milliseconds(ask: Callable[[Any], object], argument: Any, cold: VisibilityStore | None = None) -> float:
    if cold is not None:
        cold._cache.clear()
    start = time.perf_counter()
    ask(argument)
    return 1e3 * (time.perf_counter() - start)


def build(path: Path, cells: int, eyes: int) -> Path:
    """A store of the cells nearest to the middle of the grid that a store of the whole scene would have."""
    g = load_scene(realdata() / "scenes/showroom/lod-meta.json", lod=3)
    space = NavigableSpace.from_scene(g)
    whole = CellGrid.over(space, max_cells=256)
    apart = np.abs(whole.coords - np.median(whole.coords, axis=0)).sum(axis=1)
    coords = whole.coords[np.sort(np.argsort(apart, kind="stable")[:cells])]
    grid = CellGrid(whole.origin, whole.cell_size, whole.shape, coords, whole.up)
    config = {"method": "cubemap 128", "viewpoints": eyes, "cells": f"{cells} of {len(whole)}"}
    info = StoreInfo(len(g), scene_hash(g), 1 / 255, EDGES, config)
    directions = np.zeros((len(g), 10), np.uint8)
    return write_store(path, grid, info, seen(g, space, grid, eyes, directions), directions)


def seen(g: Gaussians, space: NavigableSpace, grid: CellGrid, eyes: int, directions: np.ndarray) -> Iterator[CellSet]:
    rng = np.random.default_rng(0)
    centers = space.origin + space.voxel_size * (np.argwhere(space.free) + 0.5)
    home = grid.cell_at(centers)
    for cell in range(len(grid)):
        inside = centers[home == cell]
        largest = np.zeros(len(g), np.float32)
        for eye in inside[rng.integers(len(inside), size=eyes)]:
            weights = view_weights(g, Cameras.cubemap(eye[None], 128)).largest.max(axis=0)
            directions |= seen_directions(g, weights[None], eye[None])
            np.maximum(largest, weights, out=largest)
        ids = np.flatnonzero(largest >= np.float32(EDGES[0]))
        classes = np.clip(np.searchsorted(EDGES, largest[ids], side="right") - 1, 0, len(EDGES) - 1)
        yield CellSet(ids, classes, eyes)


if __name__ == "__main__":
    main()
