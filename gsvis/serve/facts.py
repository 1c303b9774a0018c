"""Facts about a scene for a viewer, as JSON: why a Gaussian is there, which cells there are, where a walker can stand.

Scene frame and units. Nothing here is needed to draw. What is slow takes turns, so that questions delay no stream much.
"""

from __future__ import annotations

import base64
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.pvs.floor import floor_of_cells
from gsvis.pvs.store import VisibilityStore
from gsvis.pvs.walk import find_walk
from gsvis.scene.icosphere import NUM_FACES, face_directions
from gsvis.stream import StreamedScene

__all__ = ["describe_cells", "describe_floor", "describe_sight", "describe_walk", "explain"]

F64 = NDArray[np.float64]

_MOST_WEIGHED = 32  # nearest cells for which the weight is looked up
_MOST_MARKED = 1 << 22  # Gaussians of a scene; an answer takes 2.7 bytes of each


def explain(scene: StreamedScene, gaussian: int) -> dict[str, Any]:
    """Return why a Gaussian is there: its levels, its terms, and which cells see it from which directions.

    Args:
        scene: The scene.
        gaussian: Id of the Gaussian, as on the wire.

    Raises:
        ValueError: If there is no such Gaussian.
        FormatError: If the package is damaged where it is read.
    """
    contents, start = scene.source.part_of(gaussian)
    place = gaussian - start
    one = contents.gaussians(np.array([place]))
    names = contents.names
    chunk = int(contents.chunks[place])
    first, last = contents.chunk_levels[chunk].tolist()
    mean = one.means[0].astype(np.float64)
    found: dict[str, Any] = {
        "gaussian": gaussian,
        "mean": _rounded(mean),
        "scales": _rounded(one.scales[0]),
        "opacity": round(float(one.opacities[0]), 4),
        "levels": [names[first], names[last]],
        "chunk": int(scene.records.chunks[gaussian]),
        "terms": int(contents.term_counts[place]),
        "cells": None,
        "directions": None,
    }
    listed = scene.index.sets.store_of(gaussian)
    if listed is None:
        return found  # prepared without visible sets: it is always sent
    sets, own, first_cell = listed
    grid = sets.grid
    cells = sets.seers(own)
    eyes = grid.centers[cells] - mean
    distances = np.linalg.norm(eyes, axis=1)
    order = np.argsort(distances, kind="stable")
    rows = [_row(sets, own, int(cells[k]), eyes[k], float(distances[k]), n) for n, k in enumerate(order.tolist())]
    rows = [row | {"cell": row["cell"] + first_cell} for row in rows]
    faces = np.flatnonzero(np.unpackbits(sets.direction_sets[own], bitorder="little")[:NUM_FACES])
    found["cells"] = {"of": len(grid), "size": grid.cell_size, "seeing": rows}
    found["directions"] = {"of": NUM_FACES, "seen": [_rounded(row) for row in face_directions()[faces, 0]]}
    return found


def _row(sets: VisibilityStore, gaussian: int, cell: int, eye: F64, distance: float, place: int) -> dict[str, Any]:
    """Return one cell that sees a Gaussian; its weight only where it is near."""
    weight = None
    if place < _MOST_WEIGHED and (level := sets.class_of(gaussian, cell)) >= 0:
        low, high = sets.class_interval(level)
        weight = [round(low, 6), round(min(high, 1.0), 6)]
    direction = eye / distance if distance > 0 else np.array([0.0, 0.0, 1.0])
    return {"cell": cell, "distance": round(distance, 4), "direction": _rounded(direction), "weight": weight}


def describe_cells(scene: StreamedScene) -> dict[str, Any]:
    """Return the grid of cells: where eyes may be, and how many Gaussians each cell sees; and views to begin with."""
    grid: Any = scene.index.grid
    sets = scene.index.sets.whole_store
    counts = [len(scene)] * len(grid) if sets is None else sets.visible_counts.tolist()
    return {
        "origin": grid.origin.tolist(),
        "size": grid.cell_size,
        "shape": list(grid.shape),
        "up": grid.up.tolist(),
        "boxes": grid.coords.tolist(),
        "visible": counts,
        "views": scene.source.manifest.views,
    }


def describe_sight(scene: StreamedScene) -> dict[str, Any] | None:
    """Return how widely and how strongly each Gaussian is seen, a byte each; None without sets or for large scenes.

    Returns:
        `cells`, the share of the cells that see a Gaussian in steps of 1/255, rounded up, and `weights`, its largest
        weight class from any cell, spread from 0 (no cell sees it) to 255 (the highest class); (N,) uint8 by id, as
        base64. `classes`, the lowest weight of each class.
    """
    sets = scene.index.sets.whole_store
    if sets is None or sets.gaussians > _MOST_MARKED:
        return None
    seers = np.zeros(sets.gaussians, np.int64)
    classes = np.zeros(sets.gaussians, np.int64)
    for cell in range(len(sets)):
        ids, found = sets.classes(cell)
        seers[ids] += 1
        classes[ids] = np.maximum(classes[ids], found.astype(np.int64) + 1)
    edges = sets.info.class_edges
    shares = np.ceil(255.0 * seers / len(sets)), np.rint(255.0 * classes / len(edges))
    cells, weights = (base64.b64encode(share.astype(np.uint8).tobytes()).decode() for share in shares)
    return {"cells": cells, "weights": weights, "classes": [round(float(edge), 8) for edge in edges]}


def describe_floor(scene: StreamedScene) -> dict[str, Any] | None:
    """Return the floor of `floor_of_cells`; None where nothing is known of cells."""
    if not scene.source.has_cells:
        return None
    return floor_of_cells(scene.index.grid, scene.about.meters_per_unit)


def describe_walk(scene: StreamedScene) -> dict[str, Any] | None:
    """Return `packed`, the bytes of the `WalkGrid` of a scene as base64; None without cells or for large scenes."""
    sets = scene.index.sets.whole_store
    if sets is None or sets.gaussians > _MOST_MARKED:
        return None
    (contents,) = scene.source.pieces()
    finest = contents.gaussians(np.flatnonzero(contents.last == len(contents.names) - 1))
    found = find_walk(finest, sets.grid, scene.about.meters_per_unit)
    return None if found is None else {"packed": base64.b64encode(found.to_bytes()).decode()}


def _rounded(values: NDArray[np.floating[Any]]) -> list[float]:
    return [round(float(value), 5) for value in values]
