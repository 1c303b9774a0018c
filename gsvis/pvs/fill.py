"""Measure the overdraw of what cells see: the fill of views from their middles."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from gsvis.progress import Progress, silent
from gsvis.pvs.store import VisibilityStore
from gsvis.render import Fill, fill_around
from gsvis.scene.levels import Levels

__all__ = ["fill_of_cells"]


def fill_of_cells(levels: Levels, store: VisibilityStore, cells: ArrayLike, *, progress: Progress = silent) -> Fill:
    """Return the largest fill of the six views from the middle of each cell, of what the cell sees at the top level.

    Args:
        levels: The levels.
        store: Visible sets of their union.
        cells: (K,) numbers of cells.
        progress: Called with stage "fill", in cells.
    """
    numbers = np.asarray(cells, np.int64)
    top = levels.member(len(levels) - 1)
    found = []
    progress("fill", 0, len(numbers))
    for k, cell in enumerate(numbers.tolist()):
        ids = store.visible_ids(cell)
        found.append(fill_around(levels.union[ids[top[ids]]], store.grid.centers[cell][None]))
        progress("fill", k + 1, len(numbers))
    columns = [[getattr(each, name) for each in found] for name in ("splats", "mean", "worst", "until")]
    return Fill(*(np.concatenate(column) if column else np.zeros(0) for column in columns))
