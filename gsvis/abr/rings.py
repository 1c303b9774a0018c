"""The cells around a cell: shell 0 is the cell and its rings of neighbors, each further shell the next 8 nearest cells.

Cells are sorted by distance only as far as a caller needs. Threads may share everything here.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.files.cache import Cache
from gsvis.pvs.cells import Cells

__all__ = ["RINGS", "Shells"]

RINGS = 4

_SORTED = 512  # cells around a cell to sort at a time
_RECENT = 8  # `Shells.recent` has one part in 8 of the size of the cache
_SHELL = 8  # cells in a shell: a viewer may have to wait until all their sets are read


class Shells:
    """The shells around the cells of a grid.

    Args:
        grid: The cells.
        cache: Cache for sorted cells.

    Attributes:
        recent: A second cache, for candidates of shells: in `cache` they would replace those of cells.
    """

    def __init__(self, grid: Cells, cache: Cache[Any]) -> None:
        self._grid = grid
        self._cache = cache
        self._counts = dict[int, int]()
        self.recent: Cache[Any] = Cache(None if cache.max_bytes is None else cache.max_bytes // _RECENT)

    def count(self, cell: int) -> int:
        """Return the number of shells around a cell; all cells of the scene are in one of them."""
        if cell not in self._counts:
            grid = self._grid
            self._counts[cell] = 1 - (1 + len(grid.neighbors(cell)) - len(grid)) // _SHELL
        return self._counts[cell]

    def cells(self, cell: int, number: int) -> list[int]:
        """Return the cells of shell `number` around a cell."""
        if number == 0:
            return [other for ring in self._grid.rings(cell) for other in ring]
        enough = (number * _SHELL - 1) // _SORTED + 1
        key = "order", cell, 1 << (enough - 1).bit_length()
        far: NDArray[np.int64] | None = self._cache.find(key)
        if far is None:
            far = self._nearest(cell, key[2] * _SORTED)
            self._cache.keep(key, far, far.nbytes)
        found: list[int] = far[(number - 1) * _SHELL : number * _SHELL].tolist()
        return found

    def _nearest(self, cell: int, most: int) -> NDArray[np.int64]:
        """Return the `most` cells nearest to a cell, without the cell and its rings, the nearest first."""
        centers = self._grid.centers
        near = self.cells(cell, 0)
        apart = np.linalg.norm(centers - centers[cell], axis=1)
        apart[near] = np.inf
        count = min(most, len(apart) - len(near))
        if not count:
            return np.zeros(0, np.int64)
        some = np.flatnonzero(apart <= np.partition(apart, count - 1)[count - 1])
        return some[np.argsort(apart[some], kind="stable")][:count]
