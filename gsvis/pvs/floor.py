"""The floor over which a walker's eye can move, found from cells: they are all that a package knows of navigable space.

Scene frame and units, as JSON for viewers.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["floor_of_cells"]

F64 = NDArray[np.float64]

_MOST_SQUARES = 1 << 16
_EYE_M = 1.6  # height of a walker's eye, meters
_LOOKS = 4  # samples in a cell's height


def floor_of_cells(grid: Any, meters_per_unit: float, *, corners: F64 | None = None) -> dict[str, Any]:
    """Return the heights at which a walker's eye can be, over a grid of level squares.

    A square belongs to the floor if a cell lies over it. The eye is in the lowest run of cells there: in its middle,
    or 1.6 m above its lower end where the scene's unit is known and that is lower.

    Args:
        grid: A `CellGrid`, or other cells with its `up`, `cell_size` and `cell_at`.
        meters_per_unit: Meters in a scene unit, 0 if unknown.
        corners: (M, 3) corners of a box that holds all cells; None means those of a `CellGrid`.

    Returns:
        `origin` (3,) the corner of square (0, 0) at height 0, `side` of a square, `first` and `second` the unit axes
        along a row and from row to row, `up`, `columns`, `rows`, and `heights`, row after row, above `origin` along
        `up`; null where nobody can stand.
    """
    if corners is None:
        ends = [[x, y, z] for x in (0, grid.shape[0]) for y in (0, grid.shape[1]) for z in (0, grid.shape[2])]
        corners = grid.origin + grid.cell_size * np.array(ends, np.float64)
    up = grid.up
    first, second = _level_axes(up)
    along = corners @ np.stack([first, second, up], axis=1)
    low, high = along.min(axis=0), along.max(axis=0)
    side = max(grid.cell_size, float(np.sqrt((high[0] - low[0]) * (high[1] - low[1]) / _MOST_SQUARES)))
    columns, rows = (max(1, int(np.ceil((high[k] - low[k]) / side - 1e-6))) for k in range(2))
    step = grid.cell_size / _LOOKS
    levels = np.arange(low[2] + step / 2, high[2], step)
    x, y = low[0] + side * (np.arange(columns) + 0.5), low[1] + side * (np.arange(rows) + 0.5)
    flat = (x[None, :, None] * first + y[:, None, None] * second).reshape(-1, 3)
    free = np.stack([grid.cell_at(flat + level * up) >= 0 for level in levels], axis=1)
    eye = _EYE_M / meters_per_unit if meters_per_unit > 0 else np.inf
    heights = _eye_heights(free, levels, step, eye)
    return {
        "origin": (low[0] * first + low[1] * second).tolist(), "side": side, "first": first.tolist(),
        "second": second.tolist(), "up": up.tolist(), "columns": columns, "rows": rows,
        "heights": [None if np.isnan(value) else round(value, 4) for value in heights.tolist()],
    }  # fmt: skip


def _eye_heights(free: NDArray[np.bool_], levels: F64, step: float, eye: float) -> F64:
    """Return the height of the eye in the lowest run of free levels of each square; NaN without one."""
    ever = free.any(axis=1)
    start = free.argmax(axis=1)
    later = np.arange(free.shape[1]) > start[:, None]
    ends = np.where((later & ~free).any(axis=1), (later & ~free).argmax(axis=1), free.shape[1])
    bottom, top = levels[start] - step / 2, levels[ends - 1] + step / 2
    return np.where(ever, np.minimum((bottom + top) / 2, bottom + eye), np.nan)


def _level_axes(up: F64) -> tuple[F64, F64]:
    """Return two unit axes across an axis, of the scene's own axes where that is one of them."""
    helper = np.zeros(3)
    helper[int(np.abs(up).argmin())] = 1.0
    first = helper - up * (helper @ up)
    first /= np.linalg.norm(first)
    return first, np.cross(up, first)
