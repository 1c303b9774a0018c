"""The source of a streamed scene: a package, or a world (`gsvis.world.streamed`). A package is a world of one tile.

A source gives its records piece by piece, all with the color tables of one manifest. The ids of a piece follow those of
the piece before. Serving tables (`gsvis.stream.piecewise`) are computed from a source.
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
    """A scene to stream, in one piece, or in several pieces with at least one Gaussian each.

    Attributes:
        path: The folder.
        manifest: One manifest for all pieces.
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
        """Close all files."""
        ...

    @property
    def epsilon(self) -> float | None:
        """Contribution above which a term is active in a cell; None if cells do not choose terms."""
        ...

    @property
    def is_single(self) -> bool:
        """Whether the scene is one package, whose files a viewer may read one by one."""
        ...

    @property
    def has_cells(self) -> bool:
        """Whether the scene has cells with visible sets."""
        ...

    def check_parts(self) -> None:
        """Raise FormatError unless every part exists with the right size; read none of them."""
        ...

    def set_files(self, *, verify: bool = False) -> list[Path]:
        """Return the files of visible sets that have to be valid as a whole when the source is opened.

        With `verify`, their content is compared with their names. A world returns none: it checks its sets piece by
        piece when they are read, and skips damaged ones.
        """
        ...

    def read_contents(self) -> Contents:
        """Return all records; those that are not in memory are decoded and not kept."""
        ...

    def forget_records(self) -> None:
        """Free the memory of the records."""
        ...

    def part_of(self, gaussian: int) -> tuple[Contents, int]:
        """Return the records of the part that has a Gaussian, and the id of its first Gaussian."""
        ...

    def ranges(self) -> list[tuple[int, int]]:
        """Return the first id of each piece, and the end of its ids."""
        ...

    def pieces(self) -> Iterator[Contents]:
        """Yield the records of each piece, with the color tables of the whole scene."""
        ...

    def piece_weight(self, piece: int) -> int:
        """Return the factor for counts of a piece's symbols, from which the code is made."""
        ...

    def piece_links(self, piece: int, contents: Contents, means: Means) -> I64:
        """Return (P, 2) ascending pairs: id of a Gaussian of the piece, id of a Gaussian that replaces it.

        Args:
            piece: Number of the piece.
            contents: Its records.
            means: Returns the centers of the ids in [low, high), for ids before the piece.
        """
        ...

    def piece_order(self, piece: int) -> I32:
        """Return the Gaussian at each place (N,) of the visible sets of a piece; -1 where it is unknown."""
        ...

    def piece_sources(self, piece: int) -> Sequence[int]:
        """Return the pieces that may have Gaussians that those of this piece replace."""
        ...

    def read_cells(self) -> tuple[Cells, F32]:
        """Return the cells, and the weight (K,) of each class."""
        ...

    def cells_from(self, arrays: Arrays) -> Cells:
        """Return the cells from the arrays of their `to_arrays`."""
        ...

    def sets(self, cells: Cells, cache: Cache[Any], arrays: Arrays) -> CellSets:
        """Return the visible sets of the cells.

        Args:
            cells: The cells.
            cache: Cache for decoded sets.
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
        """Return all records; those that are not in memory are decoded and not kept."""
        held: Contents | None = self.package.__dict__.get("contents")
        if held is not None:
            return held
        with Package.open(self.path) as again:
            return again.contents

    def forget_records(self) -> None:
        """Free the memory of the records."""
        self.package.forget_records()

    def part_of(self, gaussian: int) -> tuple[Contents, int]:
        """Return the records of the part that has a Gaussian, and the id of its first Gaussian."""
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
        """Return the Gaussian at each place (N,) of the visible sets; -1 without visible sets."""
        return self.package.visibility.order if self.has_cells else np.full(len(self.package), -1, np.int32)

    def piece_sources(self, piece: int) -> Sequence[int]:
        """Return the one piece."""
        return [0]

    def read_cells(self) -> tuple[Cells, F32]:
        """Return the cells and the weight (K,) of each class; without visible sets, one cell that sees everything."""
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
        """Return the cells from the arrays of `CellGrid.to_arrays`."""
        return CellGrid.from_arrays(arrays)

    def sets(self, cells: Cells, cache: Cache[Any], arrays: Arrays) -> CellSets:
        """Return the visible sets; without any, each cell sees everything."""
        if not self.has_cells:
            return EveryCell(self.manifest.gaussians, self.manifest.terms)
        return PackageSets(self.package.open_sets(cache, order=arrays["set_order"]))

    def active(self) -> ActiveSets | None:
        """Return the active terms of the cells; None if no terms are sent."""
        if not self.has_cells:
            return EveryCell(self.manifest.gaussians, self.manifest.terms)
        return None if self.epsilon is None else _LazyActiveTerms(self.package)


class PackageSets(CellSets):
    """The visible sets of a package. If their files cannot be read any more, all cells see everything.

    Args:
        store: The open store.
    """

    def __init__(self, store: VisibilityStore) -> None:
        self._store = store
        self._everything = EveryCell(store.gaussians, 0)
        self._is_lost = False

    def classes(self, cell: int) -> tuple[I64, NDArray[np.uint8]]:
        """Return the ids (V,) that a cell sees, ascending, and the weight class (V,) of each."""
        return self._read(partial(self._store.classes, cell), partial(self._without_classes, cell))

    def visible_masks(self, cell: int) -> tuple[I32, NDArray[np.uint64]]:
        """Return the nonempty words of the visible set of a cell, and their masks."""
        return self._read(partial(self._store.visible_masks, cell), partial(self._everything.visible_masks, cell))

    def ring_masks(self, rings: Sequence[Sequence[int]]) -> list[list[tuple[I32, NDArray[np.uint64]]]]:
        """Return one set for each ring of cells: what its cells see and those of earlier rings do not."""
        return self._read(partial(self._store.ring_masks, rings), partial(self._everything.ring_masks, rings))

    def store_of(self, gaussian: int) -> tuple[VisibilityStore, int, int]:
        """Return the one store, the same id, and 0 for the first cell."""
        return self._store, gaussian, 0

    @property
    def whole_store(self) -> VisibilityStore:
        """The store that lists all Gaussians."""
        return self._store

    def load(self, tile: int) -> None:
        """Decode the tables that all queries need."""
        self._store.load()

    def _read(self, read: Callable[[], T], fallback: Callable[[], T]) -> T:
        """Return `read()`, or `fallback()` once the files cannot be read any more; log that once."""
        if self._is_lost:
            return fallback()
        try:
            return read()
        except OSError as error:
            found = fallback()
            self._is_lost = True
            _LOG.error("%s: visible sets cannot be read, all cells see everything: %s", self._store.path, error)
            return found

    def _without_classes(self, cell: int) -> tuple[I64, NDArray[np.uint8]]:
        """Return what a cell sees, all in class 0: its visible set if that is in memory, else all Gaussians."""
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


class _LazyActiveTerms:
    """The active terms of a package, computed on first use."""

    def __init__(self, package: Package) -> None:
        self._package = package

    def active_ids(self, cell: int) -> I64:
        """Return the ids of the active terms of a cell, ascending."""
        return self._package.active_terms.active_ids(cell)


def as_source(scene: SceneSource | Package | str | PathLike[str]) -> SceneSource:
    """Return a source; open a package by its folder."""
    if isinstance(scene, str | PathLike):
        return PackageSource(Package.open(scene))
    return PackageSource(scene) if isinstance(scene, Package) else scene


def class_weights(sets: VisibilityStore) -> F32:
    """Return a representative weight (K,) of each class of a store: the geometric mean of its bounds."""
    ends = [sets.class_interval(k) for k in range(len(sets.info.class_edges))]
    return np.array([np.sqrt(low * min(high, 1.0)) for low, high in ends], np.float32)
