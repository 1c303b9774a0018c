"""Choose viewpoints inside cells: those of a build, spread ones and random ones. Scene frame and units.

All stay in the free voxels of the navigable space, so no viewpoint lies in a wall that crosses a cell.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.pvs.cells import CellGrid
from gsvis.scene.navigable import NavigableSpace

__all__ = ["CellViewpoints", "FreeVoxels", "SharedViewpoints", "squared_distances"]

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

MERGED = 3.5
"""Voxels within which viewpoints are one (docs/design/032)."""

_OUTWARD = 0.45  # voxels from the center of a voxel to its viewpoint: reaches the rim of a cell
_INSIDE = 0.05  # least distance of a shared viewpoint from the faces of its voxel, voxels
_CORNERS = np.array(tuple(itertools.product((0, 1), repeat=3)))


@dataclass(frozen=True, eq=False)
class FreeVoxels:
    """The free voxels of one cell.

    Attributes:
        cell: Number of the cell.
        voxels: (V, 3) indices of its free voxels.
        origin: (3,) lowest corner of the voxel grid.
        voxel_size: Side of a voxel.
    """

    cell: int
    voxels: I64
    origin: F64
    voxel_size: float

    def bounds(self) -> tuple[F64, F64]:
        """Return the lowest and the highest corner (3,) of the box around the voxels."""
        low = self.voxels.min(axis=0)
        high = self.voxels.max(axis=0) + 1
        return self.origin + self.voxel_size * low, self.origin + self.voxel_size * high

    def rim(self) -> F64:
        """Return (V, 3) a point of each voxel, moved outward from the middle of all of them."""
        outward = self.voxels - self.voxels.mean(axis=0)
        points = self.voxels + 0.5 + _OUTWARD * outward / np.maximum(np.abs(outward).max(axis=1, keepdims=True), 1.0)
        return np.asarray(self.origin + self.voxel_size * points)

    def draw(self, count: int, rng: np.random.Generator) -> F64:
        """Return (count, 3) points uniform over the voxels."""
        _check.positive_int("count", count, at_least=0)
        some = self.voxels[rng.integers(len(self.voxels), size=count)]
        return np.asarray(self.origin + self.voxel_size * (some + 0.001 + 0.998 * rng.random((count, 3))))


class CellViewpoints:
    """The possible viewpoints of each cell of a grid.

    Args:
        grid: C cells.
        space: The navigable space that the grid was made from.

    Raises:
        ValueError: If a cell has no free voxel in this space.
    """

    def __init__(self, grid: CellGrid, space: NavigableSpace) -> None:
        self.grid = grid
        self.space = space
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
        return len(self.voxels(cell).voxels)

    def voxels(self, cell: int) -> FreeVoxels:
        """Return the free voxels of a cell."""
        cell = self.grid.checked(cell)
        some = self._voxels[self._starts[cell] : self._starts[cell + 1]]
        return FreeVoxels(cell, some, self.space.origin, self.space.voxel_size)

    def spread(self, cell: int, count: int) -> F64:
        """Return up to `count` viewpoints of a cell, each as far as possible from those before, the rim first.

        Args:
            cell: Number of the cell.
            count: Most viewpoints. A cell with fewer free voxels gives one viewpoint for each of them.

        Returns:
            (V, 3) viewpoints. The first k are the same for every `count` of at least k.
        """
        _check.positive_int("count", count)
        voxels = self.voxels(cell)
        points = voxels.rim()
        chosen = [int(np.linalg.norm(voxels.voxels - voxels.voxels.mean(axis=0), axis=1).argmax())]
        apart = squared_distances(points, points[chosen[0]])
        while len(chosen) < min(count, len(points)):
            chosen.append(int(apart.argmax()))
            apart = np.minimum(apart, squared_distances(points, points[chosen[-1]]))
        return np.asarray(points[chosen])

    def draw(self, cell: int, count: int, rng: np.random.Generator) -> F64:
        """Return (count, 3) viewpoints uniform over the free voxels of a cell; for measurements, not for builds."""
        return self.voxels(cell).draw(count, rng)


class SharedViewpoints:
    """The viewpoints of a build: near the corners of cells, each shared by the cells around it.

    Each cell takes the point nearest to each of its eight corners that lies in one of its own free voxels. In the order
    of the cells, a point replaces all later ones within `merged` voxels of it.

    Args:
        viewpoints: The free voxels of all cells.
        merged: Distance in voxels within which points are merged; 0 merges only equal points.

    Attributes:
        points: (P, 3) viewpoints, scene frame.
        fine: (P,) whether a viewpoint looks finely, and at lower levels too; few, but at least half of those of each
            cell.
    """

    points: F64
    fine: NDArray[np.bool_]

    def __init__(self, viewpoints: CellViewpoints, *, merged: float = MERGED) -> None:
        space = viewpoints.space
        cells = len(viewpoints.grid)
        own = np.concatenate([_near_corners(viewpoints, cell) for cell in range(cells)])  # voxel units
        stands_for = _merge(own, merged)
        kept, numbers = np.unique(stands_for, return_inverse=True)
        self.points = np.asarray(space.origin + space.voxel_size * own[kept])
        self._of_cells = numbers.reshape(cells, len(_CORNERS))
        self.fine = _thin([self.of_cell(cell) for cell in range(cells)], len(kept))

    def __len__(self) -> int:
        """Number of viewpoints."""
        return len(self.points)

    def of_cell(self, cell: int) -> I64:
        """Return the numbers of the viewpoints of a cell, ascending: one to eight."""
        return np.unique(self._of_cells[cell])


def squared_distances(points: F64, point: F64) -> F64:
    """Return (P,) squared distances of points (P, 3) to one (3,); by columns, as sums of short rows are slow."""
    x, y, z = (points[:, axis] - point[axis] for axis in range(3))
    return np.asarray(x * x + y * y + z * z)


def _near_corners(viewpoints: CellViewpoints, cell: int) -> F64:
    """Return (8, 3) the points in the free voxels of a cell that are nearest to its corners, voxel units."""
    grid = viewpoints.grid
    space = viewpoints.space
    voxels = viewpoints.voxels(cell).voxels
    corners = (grid.origin + grid.cell_size * (grid.coords[cell] + _CORNERS) - space.origin) / space.voxel_size
    found = np.empty((len(corners), 3))
    for k, corner in enumerate(corners):
        near = np.clip(corner, voxels + _INSIDE, voxels + 1.0 - _INSIDE)
        apart = squared_distances(near, corner)
        first = int(np.round(apart, 6).argmin())  # of equal ones the first: voxels are in lexicographic order
        found[k] = near[first]
    return found


def _thin(of_cells: list[I64], count: int) -> NDArray[np.bool_]:
    """Return which viewpoints to keep: at least half of those of each cell; prefers those of many cells."""
    cells_of: list[list[int]] = [[] for _ in range(count)]
    for cell, own in enumerate(of_cells):
        for k in own.tolist():
            cells_of[k].append(cell)
    spare = [len(own) // 2 for own in of_cells]
    kept = np.ones(count, bool)
    for k in sorted(range(count), key=lambda each: (len(cells_of[each]), each)):
        if all(spare[cell] for cell in cells_of[k]):
            kept[k] = False
            for cell in cells_of[k]:
                spare[cell] -= 1
    return kept


def _merge(points: F64, near: float) -> I64:
    """Return (M,) for each point the first point that replaces it: itself or one within the distance `near`."""
    from scipy.spatial import cKDTree  # here: it takes long to import

    tree = cKDTree(points)
    stands_for = np.full(len(points), -1)
    for k in range(len(points)):
        if stands_for[k] < 0:
            some = np.asarray(tree.query_ball_point(points[k], near * (1.0 + 1e-9)))
            stands_for[some[stands_for[some] < 0]] = k
    return stands_for
