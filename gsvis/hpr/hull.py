"""Build convex hulls of star-like clouds, such as flips, where many points are vertices and directions separate them.

Points are inserted from coarse to fine: first the farthest in each cell of a cubemap around the origin, then those
outside the hull so far. Each point is located by a walk over the facets from the previous one. If rounding error could
change a decision, the hull is abandoned and the caller uses Qhull.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis.hpr._kernels import hull as _kernels

__all__ = ["Hull"]

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
I32 = NDArray[np.int32]

BAND = 2e-14
"""Distance from the hull, over the largest coordinate, below which rounding may decide what is a vertex."""

_FINEST = 512
_SLACK = 2e-15
_DOUBTS = 4096


@dataclass(frozen=True, eq=False)
class Hull:
    """Convex hull of M places and the origin.

    Attributes:
        places: (M + 1, 3), in the order of the cells of a cubemap around the origin; the last is the origin.
        order: (M,) int64, input index of each place.
        corners: (F, 3) int32 indices into `places`, counter-clockwise seen from outside.
        neighbors: (F, 3) int32, the facet across the side opposite each corner.
        inner: (3,) a place strictly inside.
        size: Cells along a side of the cubemap's faces.
        reach: Largest coordinate.
    """

    places: F64
    order: I64
    corners: I32
    neighbors: I32
    inner: F64
    size: int
    reach: float

    @classmethod
    def around(cls, flips: F64, *, exact: bool = True) -> tuple[Hull | None, I64]:
        """Return the hull of flips (M, 3) and the origin, or None if rounding forbids it, and all possible vertices.

        With `exact` False, a vertex may be missed if it lies within rounding error of the hull of the other flips.
        """
        size, order, places, farthest, squared = _sort_by_cells(flips)
        reach = float(max(places.max(), -places.min()))
        levels = _levels(farthest, squared, size, len(flips))
        simplex = _simplex(places, levels[0])
        if simplex is None:
            return None, np.sort(order)
        builder = _Builder(places, simplex, reach, 2 * sum(len(level) for level in levels) + 8)
        for level in levels:
            if not builder.insert(level):
                return None, np.sort(order)
        starts = np.empty(6 * size * size, np.int32)
        hull = places, builder.corners, builder.neighbors
        _kernels.facets_of_cells(*hull, builder.inner, builder.slack, reach, size, starts)
        outside = np.empty(len(flips), bool)
        _kernels.not_inside(*hull, starts, size, builder.inner, builder.slack, builder.band, outside)
        candidates = np.flatnonzero(outside)
        builder.grow(2 * len(candidates))
        if not builder.insert(candidates) or (exact and not builder.is_certain()):
            return None, np.sort(order[candidates])
        return cls(places, order, builder.corners, builder.neighbors, builder.inner, size, reach), candidates

    @property
    def vertices(self) -> I64:
        """(K,) int64, the vertices other than the origin, ascending."""
        used = np.zeros(len(self.places), bool)
        used[self.corners.reshape(-1)] = True
        return np.sort(self.order[used[:-1]])

    def radial(self, directions: F64) -> F64:
        """Return the distance of the boundary from the origin along unit directions (D, 3); 0 if unknown."""
        starts = np.empty(6 * self.size * self.size, np.int32)
        hull = (self.places, self.corners, self.neighbors)
        slack = _SLACK * self.reach**3
        _kernels.facets_of_cells(*hull, self.inner, slack, self.reach, self.size, starts)
        out = np.empty(len(directions))
        _kernels.radial(directions, *hull, starts, self.size, self.inner, slack, out)
        return out


class _Builder:
    """A convex hull under construction."""

    def __init__(self, places: F64, simplex: I64, reach: float, capacity: int) -> None:
        self.places = places
        self.band = BAND * reach
        self.slack = _SLACK * reach**3
        self.inner = places[simplex].mean(axis=0) / 64.0  # close to the origin, so that directions are almost the same
        self._corners = np.zeros((capacity, 3), np.int32)
        self._neighbors = np.zeros((capacity, 3), np.int32)
        a, b, c, d = simplex
        self._corners[:4] = [[b, c, d], [a, d, c], [a, b, d], [a, c, b]]  # facet i lies opposite corner i
        sides = [(1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1)]
        self._neighbors[:4] = sides
        self._state = np.array([4, 0, 0], np.int64)
        self._doubtful = np.empty(_DOUBTS, np.int64)

    @property
    def corners(self) -> I32:
        return self._corners[: self._state[0]]

    @property
    def neighbors(self) -> I32:
        return self._neighbors[: self._state[0]]

    def grow(self, facets: int) -> None:
        """Allocate space for more facets."""
        room = np.zeros((facets, 3), np.int32)
        self._corners = np.concatenate([self.corners, room])
        self._neighbors = np.concatenate([self.neighbors, room])

    def insert(self, chosen: I64) -> bool:
        """Insert the chosen places; return False if rounding has broken the hull."""
        arrays = self._corners, self._neighbors, self._state
        return not _kernels.insert(self.places, chosen, *arrays, self.inner, self.slack, self.band, self._doubtful)

    def is_certain(self) -> bool:
        """Return whether rounding decided nothing: no place lies too close to the hull of the others."""
        doubts = int(self._state[2])
        if doubts > _DOUBTS:
            return False
        again = np.unique(self._doubtful[:doubts])
        self._state[2] = 0
        if len(again):
            self.grow(2 * len(again))
            if not self.insert(again) or self._state[2]:
                return False
        creases = np.zeros(len(self.places), np.int32)
        if _kernels.count_creases(self.places, self.corners, self.neighbors, self.band, creases):
            return False
        return bool(creases[self.corners.reshape(-1)].min() >= 3)


def _sort_by_cells(flips: F64) -> tuple[int, I64, F64, I64, F64]:
    """Sort flips by the cells of a cubemap with about one occupied cell for eight flips.

    Returns the size of the cubemap, the order (M,), the places in it and the origin (M + 1, 3), and for each cell the
    index of its farthest place (-1: none) and its squared distance.
    """
    wanted = len(flips) / 8
    size = _power_of_two(np.sqrt(wanted / 6))
    cells = np.empty(len(flips), np.int64)
    order = np.empty(len(flips), np.int64)
    while True:
        _kernels.cells_of(flips, size, cells)
        begins = _kernels.sort_by_cell(cells, 6 * size * size, order)
        finer = _power_of_two(size * np.sqrt(wanted / np.count_nonzero(np.diff(begins))))
        if finer < 4 * size or size >= _FINEST:
            break
        size = finer
    farthest = np.empty(6 * size * size, np.int64)
    squared = np.empty(6 * size * size)
    places = np.zeros((len(flips) + 1, 3))
    _kernels.gather(flips, order, places)
    _kernels.farthest_in_cells(places, begins, farthest, squared)
    return size, order, places, farthest, squared


def _power_of_two(size: float) -> int:
    """Return a power of two near `size`."""
    return int(2 ** np.clip(np.round(np.log2(max(size, 1.0))), 2, np.log2(_FINEST)))


def _levels(farthest: I64, squared: F64, size: int, count: int) -> list[I64]:
    """Return the farthest flips of the cells, coarse to fine; each at the first level where it is the farthest."""
    levels = []
    while True:
        levels.append(farthest[farthest >= 0])
        if size <= 4:
            break
        quads, values = (
            a.reshape(6, size // 2, 2, size // 2, 2).transpose(0, 1, 3, 2, 4).reshape(-1, 4)
            for a in (farthest, squared)
        )
        best = values.argmax(axis=1)[:, None]
        farthest, squared = (np.take_along_axis(a, best, axis=1)[:, 0] for a in (quads, values))
        size //= 2
    levels.reverse()
    taken = np.zeros(count, bool)
    for i, level in enumerate(levels):
        levels[i] = level[~taken[level]]
        taken[level] = True
    return levels


def _simplex(places: F64, coarse: I64) -> I64 | None:
    """Return four places of large volume, counter-clockwise from outside, the origin first; None if flat."""
    spots = places[coarse]
    a = int(np.einsum("ij,ij->i", spots, spots).argmax())
    across = np.cross(spots, spots[a])
    b = int(np.einsum("ij,ij->i", across, across).argmax())
    volumes = spots @ np.cross(spots[a], spots[b])
    c = int(np.abs(volumes).argmax())
    if not abs(volumes[c]) > 1e-9 * np.linalg.norm(spots[a]) ** 3:
        return None
    if volumes[c] < 0.0:
        b, c = c, b
    return np.array([len(places) - 1, coarse[a], coarse[b], coarse[c]])
