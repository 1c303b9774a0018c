"""The cells of all tiles of a world, and what each sees in the ids of the world, read when a viewer comes near.

Cells are numbered tile by tile. Those of different tiles may differ in size and overlap a little. Scene frame and
units. Threads may share everything here.
"""

from __future__ import annotations

import logging
import weakref
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.abr.index import SceneIndex
from gsvis.errors import GsvisError, SceneError
from gsvis.files.cache import Cache
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.codec import pack
from gsvis.pvs.store import VisibilityStore
from gsvis.world.beyond import Beyond, Seen
from gsvis.world.manifest import Tile
from gsvis.world.world import World

__all__ = ["WorldCells", "WorldIndex", "WorldSets"]

_LOG = logging.getLogger(__name__)
_OPEN_TILES = 64  # tiles whose stores are open at once
_TOUCH = 1e-3  # gap between two cells that touch, as a share of their size
I64 = NDArray[np.int64]
F64 = NDArray[np.float64]
_Seen = tuple[I64, NDArray[np.uint8], NDArray[np.uint8]]


@dataclass(frozen=True, eq=False)
class WorldCells:
    """C cells of several tiles.

    Attributes:
        centers: (C, 3) centers.
        sizes: (C,) side of each.
        tiles: (C,) number of the tile of each, ascending.
        places: (C,) number of each in its tile.
        boxes: (C, 3) box of each in the grid of its tile.
        up: (3,) unit up axis.
    """

    centers: F64
    sizes: F64
    tiles: I64
    places: I64
    boxes: NDArray[np.int32]
    up: F64

    @classmethod
    def read(cls, world: World, tiles: list[int]) -> WorldCells:
        """Return the cells of tiles; one that cannot be read is left out, with a line in the log.

        Raises:
            SceneError: If there is no cell.
        """
        grids: dict[int, CellGrid] = {}
        for tile in tiles:
            try:
                with world.package(tile) as package:
                    if package.manifest.visibility is not None:
                        grids[tile] = package.visibility.grid
            except (GsvisError, OSError) as error:
                _LOG.error("%s: tile %d has no cells: %s", world.path.name, tile, error)
        if not grids:
            raise SceneError(f"{world.path}: no tile has cells; prepare the world again")
        counts = [len(grid) for grid in grids.values()]
        return cls(
            np.concatenate([grid.centers for grid in grids.values()]),
            np.repeat([grid.cell_size for grid in grids.values()], counts),
            np.repeat(np.array(list(grids), np.int64), counts),
            np.concatenate([np.arange(count, dtype=np.int64) for count in counts]),
            np.concatenate([grid.coords for grid in grids.values()]),
            np.array(world.manifest.up),
        )

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Return the arrays by name, for `from_arrays`."""
        names = ("centers", "sizes", "tiles", "places", "boxes")
        return {f"cell_{name}": getattr(self, name) for name in names}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]], up: F64) -> WorldCells:
        """Return the cells that `to_arrays` took apart."""
        names = ("centers", "sizes", "tiles", "places", "boxes")
        return cls(**{name: np.array(arrays[f"cell_{name}"]) for name in names}, up=up)

    def __len__(self) -> int:
        """Return C."""
        return len(self.centers)

    @property
    def cell_size(self) -> float:
        """Side of the smallest cell."""
        return float(self.sizes.min())

    @property
    def origin(self) -> F64:
        """(3,) the lowest corner of all cells."""
        return np.asarray((self.centers - self.sizes[:, None] / 2).min(axis=0))

    def corners(self) -> F64:
        """Return (8, 3) the corners of the box around all cells."""
        low, high = self.origin, (self.centers + self.sizes[:, None] / 2).max(axis=0)
        return np.array([np.where([i, j, k], high, low) for i in (0, 1) for j in (0, 1) for k in (0, 1)], np.float64)

    def cell_at(self, points: F64) -> I64:
        """Return (M,) the cell that holds each of the (M, 3) points; -1 where there is none."""
        found = np.full(len(points), -1, np.int64)
        for tile in np.unique(self.tiles):
            some = np.flatnonzero(self.tiles == tile)
            size, boxes = self.sizes[some[0]], self.boxes[some].astype(np.int64)
            low, shape = boxes.min(axis=0), np.ptp(boxes, axis=0) + 1
            numbers = np.full(shape, -1, np.int64)
            numbers[tuple((boxes - low).T)] = some
            origin = self.centers[some[0]] - size * (boxes[0] - low + 0.5)
            places = np.floor((points - origin) / size).astype(np.int64)
            free = np.flatnonzero((found < 0) & ((places >= 0) & (places < shape)).all(axis=1))
            found[free] = numbers[tuple(places[free].T)]
        return found

    def rings(self, cell: int) -> list[list[int]]:
        """Return the cell, and its neighbors by face, by edge and by corner; those of other tiles count as by face."""
        found: list[list[int]] = [[cell], [], [], []]
        near = self.neighbors(cell)
        steps = np.abs(self.boxes[near] - self.boxes[cell]).sum(axis=1)
        same = self.tiles[near] == self.tiles[cell]
        for other, ring in zip(near.tolist(), np.where(same, steps, 1).tolist(), strict=True):
            found[ring].append(other)
        return found

    def neighbors(self, cell: int) -> I64:
        """Return the numbers of the cells that touch a cell, ascending."""
        if not 0 <= cell < len(self):
            raise ValueError(f"cell: expected a number in [0, {len(self) - 1}], got {cell!r}")
        same = self.tiles == self.tiles[cell]
        apart = np.abs(self.centers - self.centers[cell]).max(axis=1) - (self.sizes + self.sizes[cell]) / 2
        near = np.where(same, np.abs(self.boxes - self.boxes[cell]).max(axis=1) <= 1, apart <= _TOUCH * self.sizes)
        near[cell] = False
        return np.flatnonzero(near)


class WorldIndex(SceneIndex):
    """An index whose cells are those of several tiles."""

    def cell_of(self, position: NDArray[np.float64]) -> int:
        """Return the cell that contains a position (3,), of those the one with the nearest center; else the nearest."""
        cells: Any = self.grid
        apart = np.clip(cells.centers - position, -1e100, 1e100)
        inside = np.abs(apart).max(axis=1) <= cells.sizes / 2
        squares = (apart * apart).sum(axis=1)
        return int(np.where(inside, squares, squares + 1e200).argmin() if inside.any() else squares.argmin())

    def standing(self, cell: int) -> NDArray[np.uint64]:
        """Return what a cell sees of tiles that stand there at a lower level, and that ends at this level, packed."""
        sets: Any = self.sets
        ids, highest = sets.classes(cell)[0], sets.highest(cell)
        some = ids[(self.last[ids] == highest) & (highest < self.num_levels - 1)]
        return pack(some, len(self)) if len(some) else np.zeros(0, np.uint64)


class _Tile:
    """The open stores of a tile."""

    def __init__(self, own: VisibilityStore, beyond: Beyond | None) -> None:
        self.own, self.beyond = own, beyond


class WorldSets:
    """What the cells of a world see, in ids of the world.

    Args:
        world: The world.
        cells: Its cells.
        bases: First id of each node; nodes without ids are not seen.
        levels: L, number of levels.
        tables: Folder where joined stores stay; None means temporary files.
        cache: Keeps decoded sets.
    """

    def __init__(
        self, world: World, cells: WorldCells, bases: I64, levels: int, tables: Path | None, cache: Cache[Any]
    ) -> None:
        self._world, self._cells, self._bases, self._tables, self._cache = world, cells, bases, tables, cache
        self._top = levels - 1
        self._tiles: Cache[_Tile] = Cache(max_items=_OPEN_TILES)
        self._said = set[int]()

    @property
    def open_tiles(self) -> int:
        """Number of tiles whose stores are open."""
        return len(self._tiles)

    @cached_property
    def _n(self) -> int:
        return int(self._bases[-1])

    def classes(self, cell: int) -> tuple[I64, NDArray[np.uint8]]:
        """Return ascending ids of the Gaussians that a cell sees, and the class of each."""
        ids, classes, _ = self._seen(cell)
        return ids, classes

    def highest(self, cell: int) -> NDArray[np.uint8]:
        """Return the highest level that a cell sees of the part of a node that each of these Gaussians belongs to."""
        return self._seen(cell)[2]

    def visible_words(self, cell: int) -> NDArray[np.uint64]:
        """Return the visible set of a cell, packed."""
        return pack(self._seen(cell)[0], self._n)

    def of_gaussian(self, gaussian: int) -> tuple[VisibilityStore, int, int] | None:
        """Return the store of the tile that holds a Gaussian, its id there, and the number of the tile's first cell.

        None if it belongs to a district, or to a tile without cells.

        Raises:
            FormatError: If the tile is damaged.
        """
        node = int(np.searchsorted(self._bases, gaussian, "right")) - 1
        cells = np.flatnonzero(self._cells.tiles == node)
        if not len(cells):
            return None
        stores = self._tiles.find_or_make(node, lambda: self._open(node))
        return stores.own, gaussian - int(self._bases[node]), int(cells[0])

    def _seen(self, cell: int) -> _Seen:
        found: _Seen | None = self._cache.find(("seen", cell))
        if found is None:
            found = self._read(cell)
            self._cache.keep(("seen", cell), found, sum(array.nbytes for array in found))
        return found

    def _read(self, cell: int) -> _Seen:
        """Read what a cell sees. What a damaged tile cannot tell is left out; its own Gaussians are all seen then."""
        tile, place = int(self._cells.tiles[cell]), int(self._cells.places[cell])
        low, high = self._bases[tile : tile + 2].tolist()
        parts = [(np.arange(low, high), np.zeros(high - low, np.uint8), self._top)]
        try:
            stores = self._tiles.find_or_make(tile, lambda: self._open(tile))
            ids, classes = stores.own.classes(place)
            parts = [(ids + low, classes, self._top)]
            for seen in [] if stores.beyond is None else stores.beyond.of_cell(place):
                base, end = self._bases[seen.node : seen.node + 2].tolist()
                if end > base:
                    parts.append((seen.ids + base, seen.classes, self._level_of(seen)))
        except (GsvisError, OSError) as error:
            if tile not in self._said:
                self._said.add(tile)
                _LOG.error("%s: visible sets of tile %d are damaged: %s", self._world.path.name, tile, error)
        ids = np.concatenate([part[0] for part in parts])
        order = np.argsort(ids, kind="stable")
        levels = np.repeat(np.array([part[2] for part in parts], np.uint8), [len(part[0]) for part in parts])
        return ids[order], np.concatenate([part[1] for part in parts])[order], levels[order]

    def _level_of(self, seen: Seen) -> int:
        """Return the level of the world at which a part of a node stands; districts stand at all."""
        node = self._world.manifest.node(seen.node)
        return self._top - (len(node.levels) - 1 - seen.level) if isinstance(node, Tile) else self._top

    def _open(self, tile: int) -> _Tile:
        package = self._world.package(tile)
        if self._tables is not None:
            package.keep_store(self._tables / f"{self._world.manifest.tiles[tile].package[:32]}.pvs")
        found = _Tile(package.visibility, self._world.beyond(tile))
        weakref.finalize(found, _close, package, found.beyond)
        return found


def _close(package: Any, beyond: Beyond | None) -> None:
    package.close()
    if beyond is not None:
        beyond.close()
