"""Find the floor over which a walker's eye can move, from cells, the only form of navigable space in a package.

Scene frame and units, as JSON for viewers.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis.pvs.cells import Cells

__all__ = ["floor_of_cells", "level_axes", "stand_on"]

F64 = NDArray[np.float64]

_MOST_SQUARES = 1 << 16
_EYE_M = 1.6  # height of a walker's eye, meters
_LOOKS = 4  # samples in a cell's height
_LEVEL = float(np.cos(np.radians(1.0)))  # of the angle to a side of cells up to which up lies along it
_FINER = 2.0  # squares along a cell where it does not
_AROUND = 3  # squares on each side that are looked at together
_LONG = 0.6  # least length of a run in that of the longest around
_OUT = 0.2  # share of runs that stick out least


def floor_of_cells(grid: Cells, meters_per_unit: float) -> dict[str, Any]:
    """Return the heights at which a walker's eye can be, over a grid of level squares.

    A square belongs to the floor if a cell lies over it. The eye is in the lowest run of cells there: in its middle,
    or 1.6 m above its lower end where the scene's unit is known and that is lower. Where up lies along no side of a
    cell, corners of cells stick out of free space on all sides: runs are taken together with those around them, and
    such as are far shorter belong to no floor.

    Args:
        grid: The cells.
        meters_per_unit: Meters in a scene unit, 0 if unknown.

    Returns:
        `origin` (3,) the corner of square (0, 0) at height 0, `side` of a square, `first` and `second` the unit axes
        along a row and from row to row, `up`, `columns`, `rows`, and `heights`, row after row, above `origin` along
        `up`; null where nobody can stand.
    """
    up = grid.up
    first, second = level_axes(up)
    along = grid.corners() @ np.stack([first, second, up], axis=1)
    low = along.min(axis=0)
    high = along.max(axis=0)
    slanted = float(np.abs(up).max()) < _LEVEL
    size = grid.cell_size / _FINER if slanted else grid.cell_size
    side = max(size, float(np.sqrt((high[0] - low[0]) * (high[1] - low[1]) / _MOST_SQUARES)))
    columns, rows = (max(1, int(np.ceil((high[k] - low[k]) / side - 1e-6))) for k in range(2))
    step = grid.cell_size / _LOOKS
    levels = np.arange(low[2] + step / 2, high[2], step)
    x = low[0] + side * (np.arange(columns) + 0.5)
    y = low[1] + side * (np.arange(rows) + 0.5)
    flat = (x[None, :, None] * first + y[:, None, None] * second).reshape(-1, 3)
    free = np.stack([grid.cell_at(flat + level * up) >= 0 for level in levels], axis=1)
    eye = _EYE_M / meters_per_unit if meters_per_unit > 0 else np.inf
    bottom, top = _lowest_runs(free, levels, step)
    if slanted:
        bottom, top = _even_out(bottom.reshape(rows, columns), top.reshape(rows, columns))
    heights = np.minimum((bottom + top) / 2, bottom + eye)
    return {
        "origin": (low[0] * first + low[1] * second).tolist(),
        "side": side,
        "first": first.tolist(),
        "second": second.tolist(),
        "up": up.tolist(),
        "columns": columns,
        "rows": rows,
        "heights": [None if np.isnan(value) else round(value, 4) for value in heights.tolist()],
    }


def stand_on(floor: dict[str, Any], eye: ArrayLike) -> F64:
    """Return the nearest position (3,) at which a walker's eye can be, as pages find it; `eye` itself without a floor.

    Args:
        floor: From `floor_of_cells`.
        eye: (3,) position.
    """
    at = np.asarray(eye, np.float64)
    axes = np.array([floor["first"], floor["second"], floor["up"]])
    side = float(floor["side"])
    heights = np.array(floor["heights"], np.float64).reshape(floor["rows"], floor["columns"])
    x, y, height = axes @ (at - floor["origin"]) / [side, side, 1.0]
    columns = np.clip(x, np.arange(floor["columns"]), np.arange(floor["columns"]) + 1.0)
    rows = np.clip(y, np.arange(floor["rows"]), np.arange(floor["rows"]) + 1.0)
    away = (columns[None] - x) ** 2 + (rows[:, None] - y) ** 2 + ((heights - height) / side) ** 2
    if not np.isfinite(away).any():
        return at
    row, column = np.unravel_index(np.nanargmin(away), away.shape)
    place = np.array([columns[column] * side, rows[row] * side, heights[row, column]])
    return np.asarray(floor["origin"] + place @ axes)


def _lowest_runs(free: NDArray[np.bool_], levels: F64, step: float) -> tuple[F64, F64]:
    """Return the lower and upper end of the lowest run of free levels of each square; NaN without one."""
    ever = free.any(axis=1)
    start = free.argmax(axis=1)
    later = np.arange(free.shape[1]) > start[:, None]
    ends = np.where((later & ~free).any(axis=1), (later & ~free).argmax(axis=1), free.shape[1])
    bottom = levels[start] - step / 2
    top = levels[ends - 1] + step / 2
    return np.where(ever, bottom, np.nan), np.where(ever, top, np.nan)


def _even_out(bottom: F64, top: F64) -> tuple[F64, F64]:
    """Return both ends of the runs of squares (rows, columns), flat, without the corners of cells that stick out.

    Of runs around a square that are about as long as the longest of them, the lower ends of most stick out downwards,
    and the upper ends upwards.
    """
    longest = np.nanmax(_around(top - bottom), axis=0, initial=0.0)
    short = ~(top - bottom >= _LONG * longest)
    bottom = np.where(short, np.nan, bottom)
    top = np.where(short, np.nan, top)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # squares without any run around them stay without
        low = np.nanquantile(_around(bottom), 1.0 - _OUT, axis=0)
        high = np.nanquantile(_around(top), _OUT, axis=0)
    low = np.where(short, np.nan, low)
    high = np.where(short, np.nan, high)
    return low.ravel(), np.maximum(high, low).ravel()


def _around(values: F64) -> F64:
    """Return (K, rows, columns) the values of the squares around each, itself included; NaN beyond the border."""
    reach = _AROUND
    wide = np.pad(values, reach, constant_values=np.nan)
    rows, columns = values.shape
    steps = range(2 * reach + 1)
    return np.stack([wide[y : y + rows, x : x + columns] for y in steps for x in steps])


def level_axes(up: F64) -> tuple[F64, F64]:
    """Return two unit axes perpendicular to an axis, axes of the scene's own if possible."""
    helper = np.zeros(3)
    helper[int(np.abs(up).argmin())] = 1.0
    first = helper - up * (helper @ up)
    first /= np.linalg.norm(first)
    return first, np.cross(up, first)
