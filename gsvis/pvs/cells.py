"""Divide navigable space into cells, boxes of a regular grid. All viewpoints in a cell share one visible set.

Cells are cubes of whole voxels of the navigable space, in the scene's frame and units. A box without a free voxel is no
cell. Cells are numbered in lexicographic order of (x, y, z). This module knows no visibility.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.errors import SceneError
from gsvis.scene.navigable import NavigableSpace

__all__ = ["MAX_CELLS", "CellGrid", "Cells"]

F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
I64 = NDArray[np.int64]

MAX_CELLS = 100_000
"""Most cells in a grid. More cells raise an error: a grid that fine is a mistake of units."""


class Cells(Protocol):
    """C cells with numbers from 0, of one grid (`CellGrid`) or of several."""

    @property
    def centers(self) -> F64:
        """(C, 3) centers of the cells."""
        ...

    @property
    def cell_size(self) -> float:
        """Side of the smallest cell, scene units."""
        ...

    @property
    def up(self) -> F64:
        """(3,) unit up axis."""
        ...

    def __len__(self) -> int:
        """Return C."""
        ...

    def box_of(self, cell: int) -> tuple[list[float], float]:
        """Return the lowest corner (x, y, z) of the box of a cell, and its side."""
        ...

    def corners(self) -> F64:
        """Return (8, 3) the corners of a box around all cells."""
        ...

    def cell_at(self, positions: F64) -> I64:
        """Return (M,) the cell that holds each of the (M, 3) positions; -1 outside all cells."""
        ...

    def nearest(self, position: F64) -> int:
        """Return the cell that contains a position (3,); if none does, the nearest cell."""
        ...

    def neighbors(self, cell: int) -> I64:
        """Return the numbers of the cells that touch a cell, ascending."""
        ...

    def rings(self, cell: int) -> list[list[int]]:
        """Return four lists: the cell, and its neighbors by face, by edge and by corner."""
        ...

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Return the cells as arrays by name."""
        ...


@dataclass(frozen=True, eq=False, repr=False)
class CellGrid:
    """C cells of a regular grid.

    Args:
        origin: (3,) lowest corner of box (0, 0, 0), scene frame.
        cell_size: Side of a cell, scene units.
        shape: Boxes along each axis.
        coords: (C, 3) int32, the box of each cell, in lexicographic order, each box once.
        up: (3,) unit up axis.

    Raises:
        ValueError: If a shape or a value is wrong.
        SceneError: If there is no cell.
    """

    origin: F64
    cell_size: float
    shape: tuple[int, int, int]
    coords: I32
    up: F64

    def __post_init__(self) -> None:
        coords = _check.integers("coords", self.coords, ("C", 3), np.int32)
        shape = tuple(int(n) for n in _check.integers("shape", self.shape, (3,)))
        if len(coords) == 0:
            raise SceneError("no cell: no part of the grid is navigable")
        if len(coords) > MAX_CELLS:
            raise ValueError(f"coords: expected at most {MAX_CELLS:,} cells, got {len(coords):,}; make them larger")
        if not (np.isfinite(self.cell_size) and self.cell_size > 0):
            raise ValueError(f"cell_size: expected a finite number > 0, got {self.cell_size!r}")
        if min(shape) < 1 or coords.min() < 0 or (coords >= np.array(shape)).any():
            raise ValueError(f"coords: expected boxes inside a grid of {shape}, got one outside")
        flat = np.ravel_multi_index(tuple(coords.T.astype(np.int64)), shape)
        if (np.diff(flat) <= 0).any():
            raise ValueError("coords: expected each box once and in lexicographic order; sort them with np.unique")
        arrays = {
            "origin": _check.floats("origin", self.origin, (3,), np.float64),
            "coords": coords,
            "up": _check.unit_vectors("up", np.reshape(np.asarray(self.up, np.float64), (1, -1)))[0],
            "_flat": flat,
        }
        for name, array in arrays.items():
            view = array.view()
            view.flags.writeable = False
            object.__setattr__(self, name, view)
        object.__setattr__(self, "shape", shape)
        object.__setattr__(self, "cell_size", float(self.cell_size))

    @classmethod
    def over(cls, space: NavigableSpace, *, max_cells: int = 512, cell_size: float | None = None) -> CellGrid:
        """Return the cells that cover a navigable space.

        Args:
            space: The navigable space.
            max_cells: Most cells. Cells are the smallest cubes of whole voxels that keep this limit.
            cell_size: Side of a cell, scene units, rounded to whole voxels, at least one. None chooses the smallest
                side that `max_cells` allows.

        Raises:
            ValueError: If an argument is out of range, or `cell_size` needs more than `max_cells` cells.
        """
        _check.positive_int("max_cells", max_cells)
        if cell_size is not None:
            if not (np.isfinite(cell_size) and cell_size > 0):
                raise ValueError(f"cell_size: expected a finite number > 0, got {cell_size!r}")
            side = max(1, round(cell_size / space.voxel_size))
            coords = _boxes(space.free, side)
            if len(coords) > max_cells:
                raise ValueError(
                    f"cell_size: expected at most {max_cells:,} cells, got {len(coords):,} of side"
                    f" {side * space.voxel_size:.3g}; make them larger or raise max_cells"
                )
        else:
            # larger cells are fewer, except at odd borders
            low = 1
            high = max(space.free.shape)
            while low < high:
                middle = (low + high) // 2
                if len(_boxes(space.free, middle)) <= max_cells:
                    high = middle
                else:
                    low = middle + 1
            side = low
            coords = _boxes(space.free, side)
        shape = tuple(-(-n // side) for n in space.free.shape)
        return cls(space.origin, side * space.voxel_size, shape, coords.astype(np.int32), space.up)

    def __repr__(self) -> str:
        x, y, z = self.shape
        return f"CellGrid({len(self):,} cells of {self.cell_size:.3g} in {x} x {y} x {z} boxes)"

    def __len__(self) -> int:
        return len(self.coords)

    @property
    def centers(self) -> F64:
        """(C, 3) centers of the cells."""
        return np.asarray(self.origin + self.cell_size * (self.coords + 0.5))

    def bounds(self, cell: int) -> tuple[F64, F64]:
        """Return the lowest and the highest corner (3,) of a cell, scene frame."""
        low = self.origin + self.cell_size * self.coords[self.checked(cell)]
        return low, low + self.cell_size

    def checked(self, cell: int) -> int:
        """Return the number of a cell; raise unless it is in the grid.

        Raises:
            ValueError: If there is no cell of that number.
        """
        if isinstance(cell, bool) or not isinstance(cell, int | np.integer) or not 0 <= cell < len(self):
            raise ValueError(f"cell: expected a number in [0, {len(self) - 1}], got {cell!r}; cell_at finds one")
        return int(cell)

    def cell_at(self, positions: ArrayLike) -> I64:
        """Return (M,) int64, the number of the cell that holds each of the (M, 3) positions; -1 outside all cells.

        A position on a face between two cells belongs to the higher one.
        """
        points = _check.floats("positions", positions, ("M", 3), np.float64)
        # Clipped first: positions far outside must not overflow the integers.
        boxes = np.floor(np.clip((points - self.origin) / self.cell_size, -1.0, np.array(self.shape))).astype(np.int64)
        return self._numbers(boxes)

    def neighbors(self, cell: int) -> I64:
        """Return the numbers of the cells that touch a cell, ascending; at most 26."""
        steps = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        steps = steps[np.any(steps != 0, axis=1)]
        found = self._numbers(self.coords[self.checked(cell)] + steps.astype(np.int64))
        return np.sort(found[found >= 0])

    def rings(self, cell: int) -> list[list[int]]:
        """Return four lists: the cell, and its neighbors by face, by edge and by corner."""
        found: list[list[int]] = [[self.checked(cell)], [], [], []]
        others = self.neighbors(cell)
        steps = np.abs(self.coords[others] - self.coords[cell]).sum(axis=1)
        for other, ring in zip(others.tolist(), steps.tolist(), strict=True):
            found[ring].append(other)
        return found

    def nearest(self, position: F64) -> int:
        """Return the cell that contains a position (3,); if none does, the cell with the nearest center."""
        (x, y, z), (a, b, c), side = position.tolist(), self.origin.tolist(), self.cell_size
        found = self._boxes.get(((x - a) / side // 1.0, (y - b) / side // 1.0, (z - c) / side // 1.0))
        if found is not None:
            return found
        apart = np.clip(self.centers - position, -1e100, 1e100)  # squares that do not overflow
        return int(np.linalg.norm(apart, axis=1).argmin())

    def box_of(self, cell: int) -> tuple[list[float], float]:
        """Return the lowest corner (x, y, z) of the box of a cell, and its side."""
        low, _ = self.bounds(cell)
        return low.tolist(), self.cell_size

    def corners(self) -> F64:
        """Return (8, 3) the corners of the box around the whole grid."""
        x, y, z = self.shape
        ends = [[i, j, k] for i in (0, x) for j in (0, y) for k in (0, z)]
        return np.asarray(self.origin + self.cell_size * np.array(ends, np.float64))

    def gaps(self, cell: int) -> F64:
        """Return (C,) distances between the box of this cell and every box; 0 where they touch, scene units."""
        apart = np.abs(self.coords.astype(np.int64) - self.coords[self.checked(cell)]) - 1
        return np.asarray(self.cell_size * np.linalg.norm(np.maximum(apart, 0), axis=1))

    def as_dict(self) -> dict[str, Any]:
        """Return everything but `coords` as plain numbers and lists."""
        return {
            "cells": len(self),
            "origin": self.origin.tolist(),
            "cell_size": self.cell_size,
            "shape": list(self.shape),
            "up": self.up.tolist(),
        }

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Return the grid as arrays by name, for `from_arrays`."""
        box = np.array([*self.origin, self.cell_size, *self.up], np.float64)
        return {"cell_box": box, "cell_shape": np.array(self.shape, np.int64), "cell_coords": self.coords}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> CellGrid:
        """Return the grid that `to_arrays` took apart."""
        box = arrays["cell_box"]
        x, y, z = arrays["cell_shape"].tolist()
        return cls(np.array(box[:3]), float(box[3]), (x, y, z), np.array(arrays["cell_coords"]), np.array(box[4:]))

    @cached_property
    def _boxes(self) -> dict[tuple[float, ...], int]:
        return {tuple(map(float, box)): cell for cell, box in enumerate(self.coords.tolist())}

    def _numbers(self, boxes: I64) -> I64:
        """Return the numbers of cells at boxes; -1 for none."""
        inside = np.all((boxes >= 0) & (boxes < np.array(self.shape)), axis=1)
        flat = np.ravel_multi_index(tuple(np.where(inside[:, None], boxes, 0).T), self.shape)
        flats: I64 = self._flat  # type: ignore[attr-defined]
        at = np.minimum(np.searchsorted(flats, flat), len(flats) - 1)
        return np.where(inside & (flats[at] == flat), at, -1)


def _boxes(free: NDArray[np.bool_], side: int) -> I64:
    """Return (C, 3) the boxes of `side` voxels along each axis that hold a free voxel, in lexicographic order."""
    padded = np.pad(free, [(0, -n % side) for n in free.shape])
    x, y, z = (n // side for n in padded.shape)
    return np.argwhere(padded.reshape(x, side, y, side, z, side).any(axis=(1, 3, 5)))
