"""Visible sets of levels: a cell sees a Gaussian of the union if it sees it in at least one level.

The union itself is no scene: Gaussians of the low level would hide those of the high level, and the other way round.
So each level is looked at alone. The results are merged under the ids of the union.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gsvis.pvs.cell_view import CellView
from gsvis.raycast.directions import NUM_FACES

__all__ = ["join_levels"]

I64 = NDArray[np.int64]


def join_levels(views: Sequence[CellView], ids: Sequence[I64], count: int) -> CellView:
    """Return the view of a cell on the union of levels.

    Args:
        views: The view of the cell on each level.
        ids: For each level, the union ids of its Gaussians.
        count: N of the union.

    Returns:
        The Gaussians visible in some level, with the class of their largest weight and all directions. `viewpoints`
        and `growth` are those of the level that used most viewpoints.
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
