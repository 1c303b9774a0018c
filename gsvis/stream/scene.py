"""A package as a server needs it: everything that all its clients share, decoded once. Safe to share by threads."""

from __future__ import annotations

from os import PathLike

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.abr.candidates import CandidateStore
from gsvis.abr.cells import StoreCells, class_weights
from gsvis.abr.index import CellMembers, CellSets, SceneIndex
from gsvis.package.contents import Contents
from gsvis.package.layout import RECORD_BYTES
from gsvis.package.package import Package
from gsvis.pvs.cells import CellGrid
from gsvis.stream.batch import CHUNK_ROW
from gsvis.stream.header import SceneHeader

__all__ = ["StreamedScene"]


class StreamedScene:
    """A package, ready to be sent; `StreamedScene.open` makes one.

    Attributes:
        package: As opened.
        contents: Its records.
        about: What WELCOME says.
        header: WELCOME, for every client.
        index: What a scheduler knows of it.
        store: Candidates of its cells, shared by all schedulers.
        owners: (T,) int32, the Gaussian of each term.
        chunk_rows: (C,) rows of chunks as they travel.
        ending: Gaussians that are replaced by others.
    """

    def __init__(self, package: Package, *, max_cache_bytes: int = 512 << 20, pixel: float = 2e-3) -> None:
        """See `open`."""
        self.package, self.contents = package, package.contents
        counts = self.contents.term_counts
        self.owners = np.repeat(np.arange(len(counts), dtype=np.int32), counts)
        self.chunk_rows = _rows_of(self.contents)
        self.about = SceneHeader.of(package.manifest)
        self.header = self.about.to_message()
        self.index = _index_of(package, max_cache_bytes // 2)
        self.ending = int(np.count_nonzero(np.diff(self.index.replacement_offsets)))
        self.store = CandidateStore(self.index, pixel=pixel, max_bytes=max_cache_bytes - max_cache_bytes // 2)

    @classmethod
    def open(
        cls, package: Package | str | PathLike[str], *, max_cache_bytes: int = 512 << 20, pixel: float = 2e-3
    ) -> StreamedScene:
        """Read a package, all records and the visible sets of none of its cells.

        Args:
            package: An open one, which stays the caller's to close, or its folder. One without visible sets is served
                as one cell that sees everything.
            max_cache_bytes: Most bytes of what is decoded for cells.
            pixel: Angle of a pixel of the clients, radians.

        Raises:
            FormatError: If it is no package, or damaged.
            OSError: If it cannot be opened.
        """
        _check.positive_int("max_cache_bytes", max_cache_bytes, at_least=0)
        found = package if isinstance(package, Package) else Package.open(package)
        return cls(found, max_cache_bytes=max_cache_bytes, pixel=pixel)

    def __len__(self) -> int:
        """N."""
        return len(self.contents)

    def __repr__(self) -> str:
        return f"StreamedScene({self.package!r}, {len(self.index.grid):,} cells)"

    @property
    def most_hello(self) -> int:
        """Bytes that a HELLO can have at most: holdings are three bitmaps."""
        bits = 2 * len(self.contents) + len(self.contents.term_records)
        return 4096 + bits // 8 + bits // 64


class EveryCell:
    """One cell that sees all Gaussians and has all terms active.

    Args:
        gaussians: N.
        terms: T.
    """

    def __init__(self, gaussians: int, terms: int) -> None:
        self._members = CellMembers.of(np.arange(gaussians), gaussians)
        self._terms = np.arange(terms, dtype=np.uint32)

    def members(self, cell: int) -> CellMembers:
        """All."""
        return self._members

    def words(self, cell: int) -> NDArray[np.uint64]:
        """All."""
        return self._members.words

    def terms(self, cell: int) -> NDArray[np.uint32]:
        """All."""
        return self._terms


def _rows_of(contents: Contents) -> NDArray[np.void]:
    table, rows = contents.table, np.zeros(len(contents.table), CHUNK_ROW)
    for name, values in (
        ("origin", table.origins), ("step", table.steps), ("low", table.lows), ("count", table.counts),
        ("stride", table.strides), ("first_level", contents.chunk_levels[:, 0]),
        ("last_level", contents.chunk_levels[:, 1]),
    ):  # fmt: skip
        rows[name] = values
    return rows


def _index_of(package: Package, max_bytes: int) -> SceneIndex:
    contents, manifest = package.contents, package.manifest
    grid, cells, weights = _cells_of(package, contents, max_bytes)
    return SceneIndex.from_levels(
        contents.levels(), grid, cells, gaussian_bytes=float(RECORD_BYTES), term_offsets=contents.term_offsets,
        term_bytes=float(SceneHeader.of(manifest).term_bytes), class_weights=weights,
    )  # fmt: skip


def _cells_of(
    package: Package, contents: Contents, max_bytes: int
) -> tuple[CellGrid, CellSets, NDArray[np.float32] | None]:
    manifest = package.manifest
    if manifest.visibility is not None:
        sets = package.visibility
        active = None if manifest.active_terms is None else package.active_terms
        return sets.grid, StoreCells(sets, active, max_bytes=max_bytes), class_weights(sets)
    low, high = contents.gaussians().bounds(1.0) if len(contents) else (np.zeros(3), np.ones(3))
    side = max(float((high - low).max()), 1e-6)
    up = np.array(manifest.info.up)
    grid = CellGrid((low + high) / 2 - side / 2, side, (1, 1, 1), np.zeros((1, 3), np.int32), up)
    return grid, EveryCell(len(contents), len(contents.term_records)), None
