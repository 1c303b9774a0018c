"""Convex hulls of star-like clouds, such as flips: many of the points are vertices, and directions tell them apart.

Points are put in from coarse to fine: first the farthest in each cell of a cubemap around the origin, then what lies
outside the hull of these. Each is found by a walk over the facets from where the one before it was. Decisions closer
than rounding are not made: the hull is given up, and the caller asks Qhull.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import get_num_threads
from numpy.typing import NDArray

from gsvis.hpr import _kernels

__all__ = ["Hull"]

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
I32 = NDArray[np.int32]

BAND = 2e-14
"""Distance from the hull, over the largest coordinate, below which rounding may decide what is a vertex."""

_FINEST = 1024
_SLACK = 2e-15
_DOUBTS = 4096


@dataclass(frozen=True, eq=False)
class Hull:
    """Convex hull of M places and the origin.

    Attributes:
        places: (M + 1, 3); the last is the origin.
        corners: (F, 3) int32 positions in `places`, anticlockwise seen from outside.
        neighbors: (F, 3) int32, the facet across the side opposite each corner.
        inner: (3,) a place strictly inside.
        starts: (6 size^2,) int32, a facet near each cell of a cubemap around the origin.
        size: Cells along a side of the cubemap's faces.
        band: Distance below which nothing is certain.
    """

    places: F64
    corners: I32
    neighbors: I32
    inner: F64
    starts: I32
    size: int
    band: float

    @classmethod
    def around(cls, flips: F64) -> tuple[Hull | None, I64]:
        """The hull of flips (M, 3) and the origin; None where rounding forbids, with all that may be its vertices."""
        places = np.concatenate([flips, np.zeros((1, 3))])
        everything = np.arange(len(flips))
        band = BAND * float(np.abs(flips).max())
        size, farthest = _farthest(flips)
        levels = _levels(flips, farthest, size)
        simplex = _simplex(places, levels[0])
        if simplex is None:
            return None, everything
        builder = _Builder(places, simplex, band, 2 * sum(len(level) for level in levels) + 8)
        for level in levels:
            if not builder.insert(level):
                return None, everything
        starts = np.empty(6 * size * size, np.int32)
        _kernels.facets_of_cells(places, builder.corners, size, starts)
        outside = np.empty(len(flips), bool)
        arrays = places, everything, builder.corners, builder.neighbors, starts, size
        _kernels.not_inside(*arrays, builder.inner, builder.slack, band, outside)
        candidates = everything[outside]
        builder.grow(2 * len(candidates))
        if not (builder.insert(_in_order(flips, candidates, size)) and builder.is_certain()):
            return None, candidates
        _kernels.facets_of_cells(places, builder.corners, size, starts)
        return cls(places, builder.corners, builder.neighbors, builder.inner, starts, size, band), candidates

    @property
    def vertices(self) -> I64:
        """(K,) int64, the vertices other than the origin, rising."""
        used = np.zeros(len(self.places), bool)
        used[self.corners.reshape(-1)] = True
        return np.flatnonzero(used[:-1])


class _Builder:
    """A hull that grows."""

    def __init__(self, places: F64, simplex: I64, band: float, capacity: int) -> None:
        self.places, self.band = places, band
        self.slack = _SLACK * (band / BAND) ** 3
        self.inner = places[simplex].mean(axis=0)
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
        """Make room for more facets."""
        room = np.zeros((facets, 3), np.int32)
        self._corners = np.concatenate([self.corners, room])
        self._neighbors = np.concatenate([self.neighbors, room])

    def insert(self, chosen: I64) -> bool:
        """Put in the places chosen; False where rounding has spoiled the hull."""
        arrays = self._corners, self._neighbors, self._state
        return not _kernels.insert(self.places, chosen, *arrays, self.inner, self.slack, self.band, self._doubtful)

    def is_certain(self) -> bool:
        """Whether no place lies so close to the hull of the others that rounding decides what it is."""
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


def _farthest(flips: F64) -> tuple[int, I64]:
    """Size of a cubemap with about one occupied cell for eight flips, and the farthest flip in each of its cells."""
    everything = np.arange(len(flips))
    wanted = len(flips) / 8
    size = _power_of_two(np.sqrt(wanted / 6))
    while True:
        farthest = _kernels.farthest_in_cells(flips, everything, size, get_num_threads())
        occupied = int(np.count_nonzero(farthest >= 0))
        finer = _power_of_two(size * np.sqrt(wanted / occupied))
        if finer < 4 * size or size >= _FINEST:
            return size, farthest
        size = finer


def _power_of_two(size: float) -> int:
    return int(2 ** np.clip(np.round(np.log2(max(size, 1.0))), 2, np.log2(_FINEST)))


def _levels(flips: F64, farthest: I64, size: int) -> list[I64]:
    """The farthest flips of the cells, coarse to fine; each is in the first level in which it is the farthest."""
    squared = np.einsum("ij,ij->i", flips, flips)[farthest]
    squared[farthest < 0] = -1.0
    levels = []
    while True:
        levels.append(farthest[farthest >= 0])
        if size <= 4:
            break
        quads = farthest.reshape(6, size // 2, 2, size // 2, 2).transpose(0, 1, 3, 2, 4).reshape(-1, 4)
        values = squared.reshape(6, size // 2, 2, size // 2, 2).transpose(0, 1, 3, 2, 4).reshape(-1, 4)
        best = values.argmax(axis=1)[:, None]
        farthest, squared = (np.take_along_axis(a, best, axis=1)[:, 0] for a in (quads, values))
        size //= 2
    levels.reverse()
    taken = np.zeros(len(flips), bool)
    for i, level in enumerate(levels):
        levels[i] = level[~taken[level]]
        taken[level] = True
    return levels


def _simplex(places: F64, coarse: I64) -> I64 | None:
    """Four places that span the most, anticlockwise seen from outside, the origin first; None where they are flat."""
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


def _in_order(flips: F64, chosen: I64, size: int) -> I64:
    """The chosen flips in the order of their cells."""
    cells = np.empty(len(chosen), np.int64)
    _kernels.cells_of(flips, chosen, size, cells)
    return chosen[np.argsort(cells, kind="stable")]
