"""Where a streamed scene comes from: a package, or a world (`gsvis.world.streamed`). A package is a world of one tile.

A source gives its records piece by piece, all in the tables of one manifest; ids of pieces stand behind each other.
Serving tables (`gsvis.stream.piecewise`) are computed from it and map to the same scene whatever the source.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from gsvis.abr.index import ActiveSets, CellSets, nearest_replacements
from gsvis.files.cache import Cache
from gsvis.package.contents import Contents
from gsvis.package.manifest import Manifest
from gsvis.package.package import Package
from gsvis.pvs.cells import CellGrid, Cells
from gsvis.pvs.codec import ids_in
from gsvis.pvs.store import VisibilityStore

__all__ = ["EveryCell", "PackageSets", "PackageSource", "SceneSource", "as_source", "class_weights"]

F32 = NDArray[np.float32]
I32 = NDArray[np.int32]
I64 = NDArray[np.int64]
T = TypeVar("T")
Means = Callable[[int, int], F32]
Arrays = Mapping[str, NDArray[Any]]
_LOG = logging.getLogger(__name__)


class SceneSource(Protocol):
    """A scene to stream, made of pieces with at least one Gaussian each, or of one piece.

    Attributes:
        path: The folder.
        manifest: One manifest of all pieces.
    """

    path: Path
    manifest: Manifest

    def __enter__(self) -> SceneSource:
        """Return the source; it is closed when the block ends."""
        ...

    def __exit__(self, *_: object) -> None:
        """Close the source."""
        ...

    def close(self) -> None:
        """Close what is open."""
        ...

    @property
    def epsilon(self) -> float | None:
        """Contribution above which a term is active in a cell; None if cells do not choose terms."""
        ...

    @property
    def is_single(self) -> bool:
        """Whether all is one package, whose files a viewer may read one by one."""
        ...

    @property
    def has_cells(self) -> bool:
        """Whether it is known where eyes may be, and what they see from there."""
        ...

    def check_parts(self) -> None:
        """Raise unless every part is there in its size; read none of them."""
        ...

    def set_files(self, *, verify: bool = False) -> list[Path]:
        """Return the files of visible sets that are checked whole when the source is opened.

        With `verify`, they are read and compared with their names. Those of a world are checked piece by piece when
        they are read, and left out where they are damaged.
        """
        ...

    def read_contents(self) -> Contents:
        """Return all records; keep none in memory that was not there."""
        ...

    def forget_records(self) -> None:
        """Free the memory of the records."""
        ...

    def part_of(self, gaussian: int) -> tuple[Contents, int]:
        """Return the records of the part that holds a Gaussian, and the id of the first of them."""
        ...

    def ranges(self) -> list[tuple[int, int]]:
        """Return the first id of each piece, and its end."""
        ...

    def pieces(self) -> Iterator[Contents]:
        """Yield the records of each piece, in the tables of the whole scene."""
        ...

    def piece_weight(self, piece: int) -> int:
        """Return how often the symbols of a piece count for the code."""
        ...

    def piece_links(self, piece: int, contents: Contents, means: Means) -> I64:
        """Return (P, 2) ascending pairs: a Gaussian of a piece, and an id that replaces it.

        `means(low, high)` returns the centers of ids that come before the piece.
        """
        ...

    def piece_order(self, piece: int) -> I32:
        """Return (N,) the Gaussian at each place of the visible sets of a piece; -1 where it is not known."""
        ...

    def piece_sources(self, piece: int) -> Sequence[int]:
        """Return the pieces whose Gaussians those of a piece may replace."""
        ...

    def read_cells(self) -> tuple[Cells, F32]:
        """Return the cells, and the weight of each class."""
        ...

    def cells_from(self, arrays: Arrays) -> Cells:
        """Return the cells that were taken apart by their `to_arrays`."""
        ...

    def sets(self, cells: Cells, cache: Cache[Any], arrays: Arrays) -> CellSets:
        """Return what the cells see.

        Args:
            cells: The cells.
            cache: Keeps what is decoded.
            arrays: The serving tables: `set_order` of all pieces, and `last` of all Gaussians.
        """
        ...

    def active(self) -> ActiveSets | None:
        """Return the active terms of the cells; None if no terms are sent."""
        ...


class PackageSource:
    """A package as a source: one piece.

    Args:
        package: The open package.

    Attributes:
        package: The package.
        path: Its folder.
        manifest: Its manifest.
    """

    is_single = True

    def __init__(self, package: Package) -> None:
        self.package = package
        self.path = package.path
        self.manifest = package.manifest

    def __enter__(self) -> PackageSource:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return repr(self.package)

    def close(self) -> None:
        """Close the package."""
        self.package.close()

    @property
    def epsilon(self) -> float | None:
        """Contribution above which a term is active in a cell; None if cells do not choose terms."""
        return self.package.epsilon if self.has_cells else None

    @property
    def has_cells(self) -> bool:
        """Whether the package has visible sets."""
        return self.manifest.visibility is not None

    def check_parts(self) -> None:
        """Raise unless every part is there in its size; see `Package.check_parts`."""
        self.package.check_parts()

    def set_files(self, *, verify: bool = False) -> list[Path]:
        """Return the files of the visible sets; see `Package.set_files`."""
        return self.package.set_files(verify=verify)

    def read_contents(self) -> Contents:
        """Return all records; keep none in memory that was not there."""
        held: Contents | None = self.package.__dict__.get("contents")
        if held is not None:
            return held
        with Package.open(self.path) as again:
            return again.contents

    def forget_records(self) -> None:
        """Free the memory of the records."""
        self.package.forget_records()

    def part_of(self, gaussian: int) -> tuple[Contents, int]:
        """Return the records of the part that holds a Gaussian, and the id of the first of them."""
        return self.package.part_of(gaussian)

    def ranges(self) -> list[tuple[int, int]]:
        """Return the one range of all ids."""
        return [(0, len(self.package))]

    def pieces(self) -> Iterator[Contents]:
        """Yield all records."""
        yield self.package.contents

    def piece_weight(self, piece: int) -> int:
        """Return 1: there is one piece."""
        return 1

    def piece_links(self, piece: int, contents: Contents, means: Means) -> I64:
        """Return what replaces each Gaussian: the nearest ones of the next level."""
        offsets, ids = nearest_replacements(contents.levels())
        owners = np.repeat(np.arange(len(contents)), np.diff(offsets))
        return np.stack([owners, ids.astype(np.int64)], axis=1)

    def piece_order(self, piece: int) -> I32:
        """Return (N,) the Gaussian at each place of the visible sets; -1 if there are none."""
        return self.package.visibility.order if self.has_cells else np.full(len(self.package), -1, np.int32)

    def piece_sources(self, piece: int) -> Sequence[int]:
        """Return the one piece."""
        return [0]

    def read_cells(self) -> tuple[Cells, F32]:
        """Return the cells, and the weight of each class: one cell that sees everything, without visible sets."""
        if self.has_cells:
            sets = self.package.visibility
            return sets.grid, class_weights(sets)
        contents = self.package.contents
        low, high = contents.gaussians().bounds(1.0) if len(contents) else (np.zeros(3), np.ones(3))
        side = max(float((high - low).max()), 1e-6)
        up = np.array(self.manifest.info.up)
        box = np.zeros((1, 3), np.int32)
        return CellGrid((low + high) / 2 - side / 2, side, (1, 1, 1), box, up), np.ones(1, np.float32)

    def cells_from(self, arrays: Arrays) -> Cells:
        """Return the cells that were taken apart by `CellGrid.to_arrays`."""
        return CellGrid.from_arrays(arrays)

    def sets(self, cells: Cells, cache: Cache[Any], arrays: Arrays) -> CellSets:
        """Return what the cells see; all cells see everything without visible sets."""
        if not self.has_cells:
            return EveryCell(self.manifest.gaussians, self.manifest.terms)
        return PackageSets(self.package.open_sets(cache, order=arrays["set_order"]))

    def active(self) -> ActiveSets | None:
        """Return the active terms of the cells; None if no terms are sent."""
        if not self.has_cells:
            return EveryCell(self.manifest.gaussians, self.manifest.terms)
        return None if self.epsilon is None else _Later(self.package)


class PackageSets(CellSets):
    """The visible sets of a package. If their files are gone, all cells see everything, with one line in the log.

    Args:
        store: The open store.
    """

    def __init__(self, store: VisibilityStore) -> None:
        self._store = store
        self._everything = EveryCell(store.gaussians, 0)
        self._is_lost = False

    def classes(self, cell: int) -> tuple[I64, NDArray[np.uint8]]:
        """Return the ids that a cell sees, ascending, and the weight class of each."""
        return self._read(partial(self._store.classes, cell), partial(self._without_classes, cell))

    def visible_masks(self, cell: int) -> tuple[I32, NDArray[np.uint64]]:
        """Return the words of the visible set of a cell that are not empty, and their masks."""
        return self._read(partial(self._store.visible_masks, cell), partial(self._everything.visible_masks, cell))

    def ring_masks(self, rings: Sequence[Sequence[int]]) -> list[list[tuple[I32, NDArray[np.uint64]]]]:
        """Return one set for each ring of cells: what they see and those of earlier rings do not."""
        return self._read(partial(self._store.ring_masks, rings), partial(self._everything.ring_masks, rings))

    def store_of(self, gaussian: int) -> tuple[VisibilityStore, int, int]:
        """Return the store, the id, and cell 0."""
        return self._store, gaussian, 0

    @property
    def whole_store(self) -> VisibilityStore:
        """The store."""
        return self._store

    def load(self, tile: int) -> None:
        """Decode what all queries need."""
        self._store.load()

    def _read(self, read: Callable[[], T], otherwise: Callable[[], T]) -> T:
        """Return what is read, or what stands for it where the files cannot be read any more."""
        if self._is_lost:
            return otherwise()
        try:
            return read()
        except OSError as error:
            found = otherwise()
            self._is_lost = True
            _LOG.error("%s: visible sets cannot be read, all cells see everything: %s", self._store.path, error)
            return found

    def _without_classes(self, cell: int) -> tuple[I64, NDArray[np.uint8]]:
        """Return what a cell sees, all in class 0: the set that a caller may have read before, if it is in memory."""
        ids = self._everything.classes(cell)[0]
        if not self._is_lost:
            with suppress(OSError):
                ids = ids_in(*self._store.visible_masks(cell))
        return ids, np.zeros(len(ids), np.uint8)


class EveryCell(CellSets):
    """The sets of one cell that sees all Gaussians and has all terms active.

    Args:
        gaussians: N, the number of Gaussians.
        terms: T, the number of terms.
    """

    def __init__(self, gaussians: int, terms: int) -> None:
        self._gaussians = gaussians
        self._terms = terms

    def classes(self, cell: int) -> tuple[I64, NDArray[np.uint8]]:
        """Return the ids of all Gaussians, and class 0 for each."""
        return np.arange(self._gaussians), np.zeros(self._gaussians, np.uint8)

    def active_ids(self, cell: int) -> I64:
        """Return the ids of all terms."""
        return np.arange(self._terms)


class _Later:
    """The active terms of a package, found only when somebody asks for them."""

    def __init__(self, package: Package) -> None:
        self._package = package

    def active_ids(self, cell: int) -> I64:
        return self._package.active_terms.active_ids(cell)


def as_source(scene: SceneSource | Package | str | PathLike[str]) -> SceneSource:
    """Return a source; open a package by its folder."""
    if isinstance(scene, str | PathLike):
        return PackageSource(Package.open(scene))
    return PackageSource(scene) if isinstance(scene, Package) else scene


def class_weights(sets: VisibilityStore) -> F32:
    """Return the (K,) weight that stands for each class of a store: the geometric mean of its ends."""
    ends = [sets.class_interval(k) for k in range(len(sets.info.class_edges))]
    return np.array([np.sqrt(low * min(high, 1.0)) for low, high in ends], np.float32)
