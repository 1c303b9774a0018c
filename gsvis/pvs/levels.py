"""Levels looked at one by one: a Gaussian of the union is visible where any level that has it shows it.

The union itself is no scene: what belongs to the low level alone would hide Gaussians of the high one, and the other
way round. So each level is seen by itself, and what was found is brought together under the ids of the union.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gsvis.pvs.cell_view import CellView
from gsvis.raycast.directions import NUM_FACES

__all__ = ["joined"]

I64 = NDArray[np.int64]


def joined(views: Sequence[CellView], ids: Sequence[I64], count: int) -> CellView:
    """What a cell sees of a union.

    Args:
        views: What it sees of each level.
        ids: The Gaussians of each level in the union.
        count: N of the union.

    Returns:
        The Gaussians that some level shows, with the class of their largest weight and all directions; viewpoints and
        growth are those of the level that was looked at for longest.
    """
    if len(views) == 1:
        return views[0]
    best = np.full(count, -1, np.int16)
    sets = np.zeros((count, NUM_FACES // 8), np.uint8)
    for view, places in zip(views, ids, strict=True):
        rows = places[view.ids]
        best[rows] = np.maximum(best[rows], view.classes)
        sets[rows] |= view.directions
    found = np.flatnonzero(best >= 0)
    longest = max(views, key=lambda view: (view.viewpoints, view.growth))
    return CellView(
        found.astype(np.int32), best[found].astype(np.uint8), sets[found], longest.viewpoints, longest.growth
    )
