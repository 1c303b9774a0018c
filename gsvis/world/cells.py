"""The cells of all tiles of a world, and what each sees in the ids of the world, read when a viewer comes near.

Cells are numbered tile by tile. Those of different tiles may differ in size and overlap a little. Scene frame and
units. Threads may share everything here.
"""

from __future__ import annotations

import logging
import weakref
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from gsvis.abr.index import CellSets
from gsvis.errors import GsvisError, SceneError
from gsvis.files.cache import Cache
from gsvis.package.manifest import Manifest
from gsvis.package.package import PARTS
from gsvis.package.sets import open_sets
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.codec import pack_some
from gsvis.pvs.store import VisibilityStore
from gsvis.world.beyond import Beyond, SeenNode
from gsvis.world.manifest import Tile
from gsvis.world.world import World

__all__ = ["WorldCells", "WorldSets"]

_LOG = logging.getLogger(__name__)
_OPEN_TILES = 64  # tiles whose stores are open at once
_TOUCH = 1e-3  # gap between two cells that touch, as a share of their size
I64 = NDArray[np.int64]
F64 = NDArray[np.float64]
_Part = TypeVar("_Part")
_Seen = tuple[I64, NDArray[np.uint8], NDArray[np.uint8]]
_Masks = tuple[NDArray[np.int32], NDArray[np.uint64]]


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
    def read(cls, world: World, tiles: list[int], *, strict: bool = False) -> WorldCells:
        """Return the cells of tiles.

        Args:
            world: The world.
            tiles: Numbers of tiles.
            strict: Whether to refuse a tile that cannot be read; otherwise it is left out, with a line in the log.

        Raises:
            GsvisError: If a tile cannot be read, with `strict`.
            OSError: If a tile cannot be read, with `strict`.
            SceneError: If there is no cell.
        """
        grids: dict[int, CellGrid] = {}
        for tile in tiles:
            try:
                with world.package(tile) as package:
                    if package.manifest.visibility is not None:
                        grids[tile] = package.visibility.grid
            except (GsvisError, OSError) as error:
                if strict:
                    raise
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

    def box_of(self, cell: int) -> tuple[list[float], float]:
        """Return the lowest corner (x, y, z) of the box of a cell, and its side."""
        side = float(self.sizes[cell])
        return (self.centers[cell] - side / 2).tolist(), side

    def corners(self) -> F64:
        """Return (8, 3) the corners of the box around all cells."""
        low = self.origin
        high = (self.centers + self.sizes[:, None] / 2).max(axis=0)
        return np.array([np.where([i, j, k], high, low) for i in (0, 1) for j in (0, 1) for k in (0, 1)], np.float64)

    def cell_at(self, points: F64) -> I64:
        """Return (M,) the cell that holds each of the (M, 3) points; -1 where there is none."""
        found = np.full(len(points), -1, np.int64)
        for tile in np.unique(self.tiles):
            some = np.flatnonzero(self.tiles == tile)
            size = self.sizes[some[0]]
            boxes = self.boxes[some].astype(np.int64)
            low = boxes.min(axis=0)
            shape = np.ptp(boxes, axis=0) + 1
            numbers = np.full(shape, -1, np.int64)
            numbers[tuple((boxes - low).T)] = some
            origin = self.centers[some[0]] - size * (boxes[0] - low + 0.5)
            places = np.floor((points - origin) / size).astype(np.int64)
            free = np.flatnonzero((found < 0) & ((places >= 0) & (places < shape)).all(axis=1))
            found[free] = numbers[tuple(places[free].T)]
        return found

    def tiles_near(self, cell: int) -> set[int]:
        """Return the tile of a cell, and those of the cells that touch it."""
        if cell not in self._near:
            self._near[cell] = {int(self.tiles[cell]), *self.tiles[self.neighbors(cell)].tolist()}
        return self._near[cell]

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
        starts, low, high = self._spans
        center = self.centers[cell]
        reach = (0.5 + _TOUCH) * (self.sizes[cell] + self.sizes[starts[:-1]])[:, None]
        some = self._of_tiles(np.flatnonzero(((center >= low - reach) & (center <= high + reach)).all(axis=1)))
        same = self.tiles[some] == self.tiles[cell]
        sizes = self.sizes[some]
        apart = np.abs(self.centers[some] - center).max(axis=1) - (sizes + self.sizes[cell]) / 2
        near = np.where(same, np.abs(self.boxes[some] - self.boxes[cell]).max(axis=1) <= 1, apart <= _TOUCH * sizes)
        found: I64 = some[near & (some != cell)]
        return found

    def nearest(self, position: F64) -> int:
        """Return the cell that contains a position (3,), of those the one with the nearest center; else the nearest."""
        starts, low, high = self._spans
        beyond = np.clip(np.maximum(low - position, position - high), 0.0, 1e100)  # squares that do not overflow
        within = np.flatnonzero((beyond <= self.sizes[starts[:-1], None] / 2).all(axis=1))
        found = self._nearest(position, self._of_tiles(within), inside=True)
        if found is not None:
            return found[1]
        least = (beyond * beyond).sum(axis=1)
        best = np.inf, -1
        for tile in np.argsort(least, kind="stable"):
            if least[tile] > best[0]:
                break
            best = min(best, self._nearest(position, self._of_tiles(np.array([tile]))) or best)
        return best[1]

    def _nearest(self, position: F64, some: I64, *, inside: bool = False) -> tuple[float, int] | None:
        """Return the square of the distance of the nearest center of some cells, or of those around a position."""
        apart = np.clip(self.centers[some] - position, -1e100, 1e100)
        if inside:
            kept = np.abs(apart).max(axis=1, initial=0.0) <= self.sizes[some] / 2
            some = some[kept]
            apart = apart[kept]
        squares = (apart * apart).sum(axis=1)
        return (float(squares.min()), int(some[squares.argmin()])) if len(some) else None

    @cached_property
    def _near(self) -> dict[int, set[int]]:
        """Tiles near each cell, as far as they were computed."""
        return {}

    @cached_property
    def _spans(self) -> tuple[I64, F64, F64]:
        """Where the cells of each tile begin, and their number; and the box around their centers."""
        starts = np.flatnonzero(np.diff(self.tiles, prepend=-1))
        low = np.minimum.reduceat(self.centers, starts)
        high = np.maximum.reduceat(self.centers, starts)
        return np.append(starts, len(self)), low, high

    def _of_tiles(self, numbers: I64) -> I64:
        """Return the cells of some of the tiles that have cells, ascending."""
        starts = self._spans[0]
        return np.concatenate([np.zeros(0, np.int64), *(np.arange(starts[k], starts[k + 1]) for k in numbers)])


class _Tile:
    """The open stores of a tile."""

    def __init__(self, own: VisibilityStore, beyond: Beyond | None) -> None:
        self.own = own
        self.beyond = beyond


class WorldSets(CellSets):
    """What the cells of a world see, in ids of the world.

    Args:
        world: The world.
        cells: Its cells.
        bases: First id of each node; nodes without ids are not seen.
        levels: L, number of levels.
        manifests: Manifest of the package of each tile.
        cache: Keeps what is decoded.
        orders: For the ids of each tile, the Gaussian at each place of its visible sets; -1 where it is not known. None
            if none is known.
        last: (N,) the highest level of each Gaussian of the world.
    """

    def __init__(
        self,
        world: World,
        cells: WorldCells,
        bases: I64,
        levels: int,
        manifests: Mapping[int, Manifest],
        cache: Cache[Any],
        *,
        orders: NDArray[np.int32] | None,
        last: NDArray[np.uint8],
    ) -> None:
        self._world = world
        self._last = last
        self._cells = cells
        self._bases = bases
        self._cache = cache
        self._orders = orders
        self._top = levels - 1
        self._manifests = manifests
        self._tiles: Cache[_Tile] = Cache(max_items=_OPEN_TILES)
        self._said = set[int]()

    @property
    def open_tiles(self) -> int:
        """Number of tiles whose stores are open."""
        return len(self._tiles)

    @cached_property
    def _n(self) -> int:
        """Number of ids of the world."""
        return int(self._bases[-1])

    def tiles_near(self, cell: int) -> dict[int, tuple[float, float]]:
        """Return the tiles around a cell; for each, where its ids begin and end, as shares of all ids in [0, 1]."""
        found = {}
        for tile in self._cells.tiles_near(cell):
            low, high = self._bases[tile : tile + 2].tolist()
            found[tile] = low / self._n, high / self._n
        return found

    def is_open(self, tile: int) -> bool:
        """Whether the stores of a tile are open."""
        return self._tiles.find(tile) is not None

    def load(self, tile: int) -> None:
        """Open the stores of a tile, and decode what all queries need."""
        self._unless_damaged(tile, lambda stores: [stores.own.load()])

    def classes(self, cell: int) -> tuple[I64, NDArray[np.uint8]]:
        """Return ascending ids of the Gaussians that a cell sees, and the class of each."""
        ids, classes, _ = self._seen(cell)
        return ids, classes

    def highest(self, cell: int) -> NDArray[np.uint8]:
        """Return the highest level that a cell sees of the part of a node that each of these Gaussians belongs to."""
        return self._seen(cell)[2]

    def standing(self, cell: int) -> I64:
        """Return ascending ids of what a cell sees of tiles at a lower level that ends at this level."""
        ids = self.classes(cell)[0]
        highest = self.highest(cell)
        lower = np.flatnonzero(highest < self._top)  # often nothing
        ids = ids[lower]
        highest = highest[lower]
        some: I64 = ids[self._last[ids] == highest]
        return some

    def visible_masks(self, cell: int) -> _Masks:
        """Return the words of the visible set of a cell that are not empty, ascending, and their masks."""
        tile = int(self._cells.tiles[cell])
        place = int(self._cells.places[cell])
        low, high = self._bases[tile : tile + 2].tolist()

        def read(stores: _Tile) -> list[_Masks]:
            """Read the sets of the cell from the stores of its tile."""
            return [stores.own.visible_masks(place, first=low), *self._beyond(stores, place)]

        found = self._unless_damaged(tile, read)
        return pack_some(np.arange(low, high)) if found is None else found[0] if len(found) == 1 else _join(found)

    def ring_masks(self, rings: Sequence[Sequence[int]]) -> list[list[_Masks]]:
        """Return sets of each ring of cells, joined where they are of one tile; see `CellSets`."""
        found: list[list[_Masks]] = [[] for _ in rings]
        for tile in dict.fromkeys(int(self._cells.tiles[cell]) for ring in rings for cell in ring):
            mine = [[cell for cell in ring if self._cells.tiles[cell] == tile] for ring in rings]
            joined = self._unless_damaged(tile, partial(self._join_rings, tile, mine))
            for k, ring in enumerate(mine):
                found[k] += [self.visible_masks(cell) for cell in ring] if joined is None else joined[k]
        return found

    def store_of(self, gaussian: int) -> tuple[VisibilityStore, int, int] | None:
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
        """Return what a cell sees: ids, classes and highest levels; cache it."""
        found: _Seen | None = self._cache.find(("seen", cell))
        if found is None:
            found = self._read(cell)
            self._cache.keep(("seen", cell), found, sum(array.nbytes for array in found))
        return found

    def _read(self, cell: int) -> _Seen:
        """Read what a cell sees."""
        tile = int(self._cells.tiles[cell])
        place = int(self._cells.places[cell])

        def read(stores: _Tile) -> list[tuple[int, I64, NDArray[np.uint8], int]]:
            """Read the sets of the cell from the stores of its tile."""
            beyond = [] if stores.beyond is None else stores.beyond.of_cell(place)
            beyond = [seen for seen in beyond if self._has_ids(seen.node)]
            own = tile, *stores.own.classes(place), self._top
            return [own, *((seen.node, seen.ids, seen.classes, self._level_of(seen)) for seen in beyond)]

        found = self._unless_damaged(tile, read)
        if found is None:
            low, high = self._bases[tile : tile + 2].tolist()
            return np.arange(low, high), np.zeros(high - low, np.uint8), np.full(high - low, self._top, np.uint8)
        if len(found) == 1:
            node, ids, classes, level = found[0]
            ids += self._bases[node]  # the store has made them for this call
            return ids, classes, np.full(len(ids), level, np.uint8)
        some = sorted(found, key=_first)
        ids = np.concatenate([self._bases[part[0]] + part[1] for part in some])
        classes = np.concatenate([part[2] for part in some])
        highest = np.repeat(np.array([part[3] for part in some], np.uint8), [len(part[1]) for part in some])
        if not (ids[1:] < ids[:-1]).any():  # they ascend unless several pieces of one node stand around a tile
            return ids, classes, highest
        order = np.argsort(ids, kind="stable")
        return ids[order], classes[order], highest[order]

    def _join_rings(self, tile: int, rings: list[list[int]], stores: _Tile) -> list[list[_Masks]]:
        """Return the sets of rings of cells of one tile, from its open stores."""
        places = [[int(self._cells.places[cell]) for cell in ring] for ring in rings]
        own = stores.own.ring_masks(places, first=int(self._bases[tile]))
        beyond = [[each for place in ring for each in self._beyond(stores, place)] for ring in places]
        return [mine + others for mine, others in zip(own, beyond, strict=True)]

    def _beyond(self, stores: _Tile, place: int) -> list[_Masks]:
        """Return what a cell of a tile sees of other nodes."""
        found = [] if stores.beyond is None else stores.beyond.ids_of_cell(place)
        return [pack_some(np.sort(self._bases[node] + ids)) for node, ids in found if self._has_ids(node)]

    def _has_ids(self, node: int) -> bool:
        """Return whether a node has ids."""
        return bool(self._bases[node + 1] > self._bases[node])

    def _level_of(self, seen: SeenNode) -> int:
        """Return the level of the world at which a part of a node stands; districts stand at all."""
        node = self._world.manifest.node(seen.node)
        return self._top - (len(node.levels) - 1 - seen.level) if isinstance(node, Tile) else self._top

    def _unless_damaged(self, tile: int, read: Callable[[_Tile], list[_Part]]) -> list[_Part] | None:
        """Read from the stores of a tile; None if they are damaged: its own Gaussians are all seen then, no others."""
        try:
            return read(self._tiles.find_or_make(tile, lambda: self._open(tile)))
        except (GsvisError, OSError) as error:
            if tile not in self._said:
                self._said.add(tile)
                _LOG.error("%s: visible sets of tile %d are damaged: %s", self._world.path.name, tile, error)
            return None

    def _open(self, tile: int) -> _Tile:
        """Open the stores of a tile."""
        parts = self._world.package_path(tile) / PARTS
        low, high = self._bases[tile : tile + 2].tolist()
        order = None if self._orders is None or not low < high else self._orders[low:high]
        order = None if order is None or order[0] < 0 else order
        own = open_sets(parts, self._manifests[tile], self._cache.scope(("tile", tile)), order=order)
        found = _Tile(own, self._world.beyond(tile))
        if found.beyond is not None:
            found.beyond.store.cache = self._cache.scope(("beyond", tile))
            weakref.finalize(found, found.beyond.close)
        return found


def _first(part: tuple[Any, ...]) -> Any:
    """Return the node of a part."""
    return part[0]


def _join(sets: list[_Masks]) -> _Masks:
    """Return the words of several sets together; two nodes may share a word."""
    numbers, masks = (np.concatenate(arrays) for arrays in zip(*sets, strict=True))
    order = np.argsort(numbers, kind="stable")
    numbers = numbers[order]
    masks = masks[order]
    starts = np.flatnonzero(np.diff(numbers, prepend=-1))
    return numbers[starts], np.bitwise_or.reduceat(masks, starts) if len(starts) else masks
