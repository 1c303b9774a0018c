"""Measure the overdraw of what cells see: the fill of views from their middles."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis.jobs.in_order import in_order
from gsvis.progress import Progress, silent
from gsvis.pvs.store import VisibilityStore
from gsvis.render import Fill, fill_around
from gsvis.render.fill import SIDE, STEP, SampledFill, sample_fill_around
from gsvis.scene.levels import Levels

__all__ = ["describe_overdraw", "fill_of_cells", "read_overdraw", "sample_fill_of_cells"]

_MOST = 1e12  # splats: more is damage


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
    plain = levels.union.without_harmonics()
    found = []
    progress("fill", 0, len(numbers))
    for k, cell in enumerate(numbers.tolist()):
        ids = store.visible_ids(cell)
        found.append(fill_around(plain[ids[top[ids]]], store.grid.centers[cell][None]))
        progress("fill", k + 1, len(numbers))
    columns = [[getattr(each, name) for each in found] for name in ("splats", "mean", "worst", "until")]
    return Fill(*(np.concatenate(column) if column else np.zeros(0) for column in columns))


def sample_fill_of_cells(
    levels: Levels, store: VisibilityStore, beyond: VisibilityStore | None = None, *, progress: Progress = silent
) -> SampledFill:
    """Return what `fill_of_cells` does for all cells but the fill until opaque, from sampled pixels.

    Args:
        levels: The levels; the Gaussians of `beyond` follow those of `store`.
        store: Visible sets of their union, or of its first Gaussians.
        beyond: What the same cells see of the Gaussians behind these; None for nothing.
        progress: Called with stage "fill", in cells.
    """
    top = levels.member(len(levels) - 1)

    def seen() -> Iterator[tuple[int, NDArray[np.bool_]]]:
        """Yield each cell with a mask of what it sees at the top level."""
        for cell in range(len(store)):
            shown = np.zeros(len(levels.union), np.bool_)
            shown[store.visible_ids(cell)] = True
            if beyond is not None:
                shown[store.gaussians + beyond.visible_ids(cell)] = True
            shown &= top
            yield cell, shown

    def sample(looked: tuple[int, NDArray[np.bool_]]) -> tuple[float, float, float]:
        """Return the row of a cell."""
        cell, shown = looked
        found = sample_fill_around(levels.union.showing(shown), store.grid.centers[cell][None])
        return found.splats[0], found.mean[0], found.worst[0]

    rows = np.zeros((len(store), 3))
    progress("fill", 0, len(store))
    for cell, row in enumerate(in_order(sample, seen())):
        rows[cell] = row
        progress("fill", cell + 1, len(store))
    return SampledFill(*rows.T)


def describe_overdraw(found: SampledFill) -> dict[str, Any]:
    """Return the fill of all cells for JSON: three lists, in the order of the cells."""
    return {
        "side": SIDE,
        "step": STEP,
        "splats": found.splats.astype(np.int64).tolist(),
        "mean": np.round(found.mean, 1).tolist(),
        "worst": found.worst.astype(np.int64).tolist(),
    }


def read_overdraw(record: Any, cells: int) -> SampledFill | None:
    """Return the fill of all cells from JSON; None unless it has three numbers >= 0 for each of `cells` cells."""
    if not isinstance(record, dict):
        return None
    columns = []
    for name in SampledFill._fields:
        values = record.get(name)
        if not isinstance(values, list) or len(values) != cells:
            return None
        if not all(type(value) in (int, float) and 0 <= value < _MOST for value in values):
            return None
        columns.append(np.array(values, np.float64))
    return SampledFill(*columns)
