"""Viewpoints inside cells: spread ones for a build, random ones for tests. Scene frame and units.

Both stay in the free voxels of the navigable space, so no viewpoint lies in a wall that crosses a cell.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.pvs.cells import CellGrid
from gsvis.scene.navigable import NavigableSpace

__all__ = ["CellViewpoints"]

F64 = NDArray[np.float64]

_OUTWARD = 0.45  # voxels from the center of a voxel to its viewpoint: reaches the rim of a cell


class CellViewpoints:
    """The possible viewpoints of each cell of a grid.

    Args:
        grid: C cells.
        space: The navigable space that the grid was made from.

    Raises:
        ValueError: If a cell has no free voxel in this space.
    """

    def __init__(self, grid: CellGrid, space: NavigableSpace) -> None:
        self.grid, self.space = grid, space
        voxels = np.argwhere(space.free)
        cells = grid.cell_at(space.origin + space.voxel_size * (voxels + 0.5))
        order = np.argsort(cells, kind="stable")
        order = order[np.count_nonzero(cells < 0) :]
        self._voxels = voxels[order]
        self._starts = np.searchsorted(cells[order], np.arange(len(grid) + 1))
        empty = np.flatnonzero(np.diff(self._starts) == 0)
        if len(empty):
            raise ValueError(
                f"space: expected a free voxel in every cell, got none in cell {empty[0]}; use the space of the grid"
            )

    def free_voxels(self, cell: int) -> int:
        """Return the number of free voxels in a cell."""
        cell = self.grid.checked(cell)
        return int(self._starts[cell + 1] - self._starts[cell])

    def spread(self, cell: int, count: int) -> F64:
        """Return up to `count` viewpoints of a cell, each as far as possible from those before it, the rim first.

        Args:
            cell: Number of the cell.
            count: Most viewpoints. A cell with fewer free voxels gives one viewpoint for each of them.

        Returns:
            (V, 3) viewpoints. The first k are the same for every `count` of at least k.
        """
        _check.positive_int("count", count)
        voxels = self._candidates(cell)
        middle = voxels.mean(axis=0)
        outward = voxels - middle
        length = np.linalg.norm(outward, axis=1, keepdims=True)
        points = voxels + 0.5 + _OUTWARD * outward / np.maximum(np.abs(outward).max(axis=1, keepdims=True), 1.0)
        chosen = [int(length[:, 0].argmax())]
        apart = np.sum((points - points[chosen[0]]) ** 2, axis=1)
        while len(chosen) < min(count, len(points)):
            chosen.append(int(apart.argmax()))
            apart = np.minimum(apart, np.sum((points - points[chosen[-1]]) ** 2, axis=1))
        return np.asarray(self.space.origin + self.space.voxel_size * points[chosen])

    def draw(self, cell: int, count: int, rng: np.random.Generator) -> F64:
        """Return (count, 3) viewpoints uniform over the free voxels of a cell; for measurements, not for builds."""
        _check.positive_int("count", count, at_least=0)
        voxels = self._candidates(cell)
        some = voxels[rng.integers(len(voxels), size=count)]
        return np.asarray(self.space.origin + self.space.voxel_size * (some + 0.001 + 0.998 * rng.random((count, 3))))

    def _candidates(self, cell: int) -> NDArray[np.int64]:
        cell = self.grid.checked(cell)
        return self._voxels[self._starts[cell] : self._starts[cell + 1]]
