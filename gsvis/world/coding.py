"""How many bytes the files of a tile take: stand-ins for its levels, and what a tried cell sees, coded as stores do.

Levels are not trained for that: a lower level is the part of the next one that covers most. Scene frame and units.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis.prepare.surroundings import Surroundings
from gsvis.pvs.cell_view import CellView
from gsvis.pvs.coded_size import bytes_of_cell, bytes_of_directions
from gsvis.pvs.sightings import Sighting
from gsvis.raycast.directions import face_of
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.scene.morton import morton_codes
from gsvis.scene.navigable import NavigableSpace
from gsvis.train.levels import LevelsConfig

__all__ = [
    "TileBytes",
    "bytes_of_space",
    "bytes_of_view",
    "direction_sets",
    "levels_of",
    "surroundings_of",
]

U8 = NDArray[np.uint8]


@dataclass(frozen=True)
class TileBytes:
    """Bytes of the files of a tile, mean of the tried ones.

    Attributes:
        record: A Gaussian in a package without sets and terms, its share of the table of chunks included.
        directions: The direction sets in the two stores of a tile.
        cell: What a cell adds to the two stores, if no neighbor says a part of it.
        space: Where eyes may be.
    """

    record: float
    directions: float
    cell: float
    space: float


def direction_sets(view: CellView, others: Sequence[Sighting], means: NDArray[np.float32]) -> U8:
    """Return (N, 10) direction sets toward the viewpoints of a cell and those of other looks.

    Args:
        view: What the cell sees.
        others: What other viewpoints see.
        means: (N, 3) centers.
    """
    sets = np.zeros((len(means), view.directions.shape[1]), np.uint8)
    sets[view.ids] = view.directions
    for each in others:
        ids = each.ids[each.seen]
        faces = face_of(each.viewpoint - means[ids])
        sets[ids, faces // 8] |= (1 << faces % 8).astype(np.uint8)
    return sets


def bytes_of_view(view: CellView, sets: U8, own: int, classes: int) -> tuple[float, float]:
    """Return the bytes of direction sets, and of the set of a cell with its classes, in both stores of a tile.

    Args:
        view: What the cell sees: ids of the tile, then of what stands around it.
        sets: (N, 10) direction sets of both.
        own: Gaussians of the tile.
        classes: Number of classes of weights.
    """
    directions = cell = 0
    for low, count in ((0, own), (own, len(sets) - own)):
        if not count:
            continue
        some = slice(*np.searchsorted(view.ids, [low, low + count]))
        cell += bytes_of_cell(view.ids[some] - low, view.classes[some], count, classes)
        directions += bytes_of_directions(sets[low : low + count])
    return float(directions), float(cell)


def bytes_of_space(space: NavigableSpace) -> float:
    """Return the bytes of where eyes may be in a tile."""
    arrays = space.free, space.occupied, space.targets
    return float(sum(array.nbytes for array in arrays if array is not None))


def levels_of(g: Gaussians, levels: LevelsConfig | None) -> Levels:
    """Return levels of about the right sizes, near the order of a package."""
    ordered, first = _order_like_levels(g, levels)
    top, names = (0, ("high",)) if levels is None else (len(levels.shares), levels.names)
    return Levels(ordered, first, np.full(len(g), top, np.uint8), names)


def surroundings_of(g: Gaussians, levels: LevelsConfig | None) -> Surroundings:
    """Return a scene of SH degree 0 as what stands around a tile of these levels."""
    ordered, first = _order_like_levels(g, levels)
    return Surroundings(ordered, first, np.full(len(g), 0 if levels is None else len(levels.shares), np.uint8))


def _order_like_levels(g: Gaussians, levels: LevelsConfig | None) -> tuple[Gaussians, U8]:
    """Return a scene near the order of a package, and the lowest level (N,) of each Gaussian, by what covers most."""
    first = np.zeros(len(g), np.uint8)
    if levels is not None:
        strength = g.opacities * np.sort(g.scales, axis=1)[:, 1:].prod(axis=1)
        rank = np.empty(len(g))
        rank[np.argsort(-strength, kind="stable")] = (np.arange(len(g)) + 0.5) / max(len(g), 1)
        first = np.searchsorted(levels.shares, rank).astype(np.uint8)
    middle = np.median(g.means, axis=0).astype(np.float64) if len(g) else np.zeros(3)
    half = float(np.abs(g.means - middle).max(initial=0.0))
    order = np.lexsort((morton_codes(g.means, middle, max(half, 1e-9)), first))
    return g[order], first[order]
