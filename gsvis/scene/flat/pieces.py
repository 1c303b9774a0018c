"""Cut painted charts into pieces of about one color: small ones in areas with detail, large ones elsewhere.

All pieces are cut together, in rounds. A cut is placed where it reduces the variance of color most, as in a regression
tree. Candidates are random, so that no lattice appears. Sums over pieces come from summed-area tables.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["Canvas", "Pieces", "cut"]

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

CANDIDATES = (0.2, 0.42, 0.58, 0.8)
SPREAD = 0.004  # worth of a cut by its size alone, so that plain walls are cut too
BENT = 0.06  # the same, for curvature
HOLE = 0.05  # worth of a clean edge of a hole
RIM = 0.001  # worth of a narrow border, a square meter, so that objects end sharply
FALL = 0.72  # how much less a cut has to be worth in the next round
WIDEST = 0.22  # meters; wider pieces would be drawn before what hangs in front of them
LONGEST = 4.0  # longest side over the shorter one beyond which only the longer is cut


@dataclass(frozen=True)
class Canvas:
    """The finished colors of a chart.

    Args:
        colors: (H, W, 3) in [0, 1]; rows along v.
        solid: (H, W) whether there is surface.
        size: Meters along u and v.
        detail: Weight of its detail.
        bend: Curvature.
        rim: Weight of a sharp border.
    """

    colors: F64
    solid: NDArray[np.bool_]
    size: tuple[float, float]
    detail: float
    bend: float
    rim: float


@dataclass(frozen=True)
class Pieces:
    """P pieces of charts.

    Args:
        charts: (P,) index of the chart.
        low: (P, 2) lower corner (u, v) in [0, 1].
        high: (P, 2) upper corner.
        colors: (P, 3) mean colors.
        cover: (P,) share that is surface.
        spread: (P,) standard deviation of the color inside.
    """

    charts: I64
    low: F64
    high: F64
    colors: F64
    cover: F64
    spread: F64


class _Tables:
    """Summed-area tables of all canvases in one array: weight, weighted colors, weighted squares."""

    def __init__(self, canvases: Sequence[Canvas]) -> None:
        shapes = np.array([canvas.solid.shape for canvas in canvases], np.int64)
        self.rows, self.columns = shapes.T
        self.starts = np.cumsum([0, *((shapes + 1).prod(axis=1))[:-1]])
        self.sums = np.zeros((int((shapes + 1).prod(axis=1).sum()), 5))
        for start, canvas in zip(self.starts, canvases, strict=True):
            rows, columns = canvas.solid.shape
            table = self.sums[start : start + (rows + 1) * (columns + 1)].reshape(rows + 1, columns + 1, 5)
            table[1:, 1:, 0] = canvas.solid
            table[1:, 1:, 1:4] = canvas.colors * canvas.solid[..., None]
            red, green, blue = np.moveaxis(canvas.colors, 2, 0)
            table[1:, 1:, 4] = (red * red + green * green + blue * blue) * canvas.solid
            np.cumsum(table, axis=0, out=table)
            np.cumsum(table, axis=1, out=table)
        self.texel = np.array([canvas.size for canvas in canvases]) / shapes[:, ::-1]
        self.detail = np.array([canvas.detail for canvas in canvases])
        self.rim = np.array([canvas.rim for canvas in canvases])
        self.bend = np.array([canvas.bend for canvas in canvases])

    def corners(self, charts: I64, box: I64) -> Corners:
        """Return the sums up to the corners of (n, 4) boxes: first column, first row, end column, end row."""
        wide = self.columns[charts] + 1
        start = self.starts[charts]
        top = start + box[:, 1] * wide
        bottom = start + box[:, 3] * wide
        ends = (bottom + box[:, 2], bottom + box[:, 0], top + box[:, 2], top + box[:, 0])
        return Corners(wide, start, *(self.sums.take(each, axis=0) for each in ends))

    def first_part(self, found: Corners, chosen: I64, box: I64, axis: int, at: I64) -> F64:
        """Return (m, 5) sums over the first parts of chosen boxes, cut at a column (axis 0) or a row (axis 1)."""
        wide = found.wide[chosen]
        start = found.start[chosen]
        if axis == 0:
            upper = self.sums.take(start + box[:, 3] * wide + at, axis=0)
            lower = self.sums.take(start + box[:, 1] * wide + at, axis=0)
            return np.asarray(upper - found.left_end[chosen] - lower + found.left_start[chosen])
        row = start + at * wide
        right = self.sums.take(row + box[:, 2], axis=0)
        left = self.sums.take(row + box[:, 0], axis=0)
        return np.asarray(right - left - found.right_start[chosen] + found.left_start[chosen])


class Corners(NamedTuple):
    """Sums up to the corners of n boxes.

    Attributes:
        wide: (n,) columns of each table.
        start: (n,) where each table begins.
        right_end: (n, 5) sums up to end column and end row.
        left_end: (n, 5) up to first column and end row.
        right_start: (n, 5) up to end column and first row.
        left_start: (n, 5) up to first column and first row.
    """

    wide: I64
    start: I64
    right_end: F64
    left_end: F64
    right_start: F64
    left_start: F64

    @property
    def whole(self) -> F64:
        """(n, 5) sums over the boxes."""
        return np.asarray(self.right_end - self.left_end - self.right_start + self.left_start)


def cut(canvases: Sequence[Canvas], count: int, rng: np.random.Generator) -> Pieces:
    """Return about `count` pieces of all canvases.

    Args:
        canvases: Charts to cut.
        count: Least number of pieces.
        rng: Source of randomness.
    """
    tables = _Tables(canvases)
    charts = np.arange(len(canvases))
    zeros = np.zeros(len(charts), np.int64)
    boxes = np.stack([zeros, zeros, tables.columns, tables.rows], axis=1)
    worth, where = _best_cuts(tables, charts, boxes, rng)
    bar = float(worth.max())
    while len(boxes) < count and bar > 1e-12:
        chosen = worth > bar
        if not chosen.any():
            bar *= FALL
            continue
        most = count - len(boxes)
        if chosen.sum() > most:
            chosen = worth >= np.partition(worth, -most)[-most]
        first = boxes[chosen].copy()
        second = boxes[chosen].copy()
        rows = np.arange(int(chosen.sum()))
        axis = where[chosen, 0]
        first[rows, 2 + axis] = where[chosen, 1]
        second[rows, axis] = where[chosen, 1]
        new = np.concatenate([first, second])
        owners = np.tile(charts[chosen], 2)
        new_worth, new_where = _best_cuts(tables, owners, new, rng)
        kept = ~chosen
        charts = np.concatenate([charts[kept], owners])
        boxes = np.concatenate([boxes[kept], new])
        worth = np.concatenate([worth[kept], new_worth])
        where = np.concatenate([where[kept], new_where])
    return _pieces(tables, charts, boxes)


def _best_cuts(tables: _Tables, charts: I64, boxes: I64, rng: np.random.Generator) -> tuple[F64, I64]:
    """Return the worth (n,) of the best cut of each box, and (n, 2) its axis and its place; -1 for no cut."""
    found = tables.corners(charts, boxes)
    whole = found.whole
    best = np.full(len(boxes), -1.0)
    where = np.zeros((len(boxes), 2), np.int64)
    extent = boxes[:, 2:] - boxes[:, :2]
    sides = extent * tables.texel[charts]
    before = _scatter(whole)
    edge = _holes(whole, boxes)
    for axis in range(2):
        shifts = rng.uniform(-0.08, 0.08, (len(CANDIDATES), len(boxes)))
        allowed = (extent[:, axis] > 1) & (sides[:, axis] * LONGEST > sides[:, 1 - axis]) & (whole[:, 0] > 0.0)
        some = np.flatnonzero(allowed)
        mine = boxes[some]
        owners = charts[some]
        long = extent[some, axis]
        along = sides[some, axis]
        beside = sides[some, 1 - axis]
        by_size = sides[some].prod(axis=1) * along**2 / 16.0
        plain = by_size * (SPREAD + BENT * tables.bend[owners])
        area = tables.texel[owners].prod(axis=1)
        sharp = area * tables.detail[owners]
        for share, shift in zip(CANDIDATES, shifts, strict=True):
            at = np.rint(long * (share + shift[some])).astype(np.int64)
            at = mine[:, axis] + np.clip(at, 1, np.maximum(long - 1, 1))
            first = mine.copy()
            second = mine.copy()
            first[:, 2 + axis] = at
            second[:, axis] = at
            part = tables.first_part(found, some, mine, axis, at)
            rest = whole[some] - part
            gain = sharp * (before[some] - _scatter(part) - _scatter(rest))
            clean = area * (edge[some] - _holes(part, first) - _holes(rest, second))
            narrow = RIM * _rims(tables, owners, mine, axis, at) * tables.rim[owners] * beside
            balance = 4.0 * (at - mine[:, axis]) * (mine[:, 2 + axis] - at) / np.maximum(long, 1) ** 2
            worth = np.maximum(0.0, along - WIDEST) * balance + gain + HOLE * clean + plain * balance + narrow
            better = worth > best[some]
            best[some[better]] = worth[better]
            where[some[better], 0] = axis
            where[some[better], 1] = at[better]
    return best, where


def _scatter(sums: F64) -> F64:
    """Return (n,) squared deviations from the mean color, summed."""
    weight = np.maximum(sums[:, 0], 1e-9)
    red = sums[:, 1]
    green = sums[:, 2]
    blue = sums[:, 3]
    return np.asarray(sums[:, 4] - (red * red + green * green + blue * blue) / weight)


def _holes(sums: F64, boxes: I64) -> F64:
    """Return (n,) a measure of how much boxes mix surface and hole: 0 if a box has only one of them."""
    area = (boxes[:, 2:] - boxes[:, :2]).prod(axis=1)
    return np.asarray(sums[:, 0] * (1.0 - sums[:, 0] / np.maximum(area, 1)))


def _rims(tables: _Tables, charts: I64, boxes: I64, axis: int, at: I64) -> F64:
    """Return (n,) how much narrower a cut makes pieces at the border of the chart, meters."""
    ends = (tables.columns, tables.rows)[axis][charts]
    low = np.where(boxes[:, axis] == 0, boxes[:, 2 + axis] - at, 0)
    high = np.where(boxes[:, 2 + axis] == ends, at - boxes[:, axis], 0)
    return np.asarray((low + high) * tables.texel[charts, axis])


def _pieces(tables: _Tables, charts: I64, boxes: I64) -> Pieces:
    """Return the boxes as pieces, without those that are mostly hole."""
    sums = tables.corners(charts, boxes).whole
    area = (boxes[:, 2:] - boxes[:, :2]).prod(axis=1)
    cover = sums[:, 0] / np.maximum(area, 1)
    kept = cover > 0.35
    charts = charts[kept]
    boxes = boxes[kept]
    sums = sums[kept]
    cover = cover[kept]
    size = np.stack([tables.columns[charts], tables.rows[charts]], axis=1)
    spread = np.sqrt(np.maximum(_scatter(sums), 0.0) / sums[:, 0])
    return Pieces(charts, boxes[:, :2] / size, boxes[:, 2:] / size, sums[:, 1:4] / sums[:, :1], cover, spread)
