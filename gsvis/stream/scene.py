"""A scene that is ready to be sent to the sessions of a server. Threads may share it.

It combines a source (`gsvis.stream.source`) and serving tables (`gsvis.stream.piecewise`), in memory or mapped.
"""

from __future__ import annotations

import base64
import copy
from collections.abc import Mapping
from dataclasses import dataclass, replace
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.abr.candidates import CandidateIndex
from gsvis.abr.cones import TermCones
from gsvis.abr.holdings import Holdings
from gsvis.abr.index import SceneIndex
from gsvis.abr.tables import CandidateTables, TableNumbers
from gsvis.files.cache import Cache
from gsvis.package.contents import Contents
from gsvis.package.package import Package
from gsvis.package.rounding import Chunks, Quality
from gsvis.stream.batch import CHUNK_ROW
from gsvis.stream.coding import Coding, coarsen
from gsvis.stream.header import SceneHeader
from gsvis.stream.piecewise import SceneTables, make_tables
from gsvis.stream.source import SceneSource, as_source

__all__ = ["TERMS", "RecordTables", "StreamedScene"]

TERMS = ("pose", "cell")
"""Ways to choose the terms that are sent; see `StreamedScene.sending`."""


@dataclass(frozen=True, eq=False)
class RecordTables:
    """The records of a scene, prepared to be coded many times.

    Attributes:
        parts: (N, 16) uint16, the records of Gaussians, see `Coding.split_records`.
        chunks: (N,) int32, the chunk of each Gaussian.
        starts: (C + 1,) id of the first Gaussian of each chunk, and N.
        chunk_rows: (C,) of `CHUNK_ROW`, as sent.
        chunk_numbers: Rows of chunks, as the coder needs them.
        owners: (T,) int32, the Gaussian of each term.
        term_records: (T, B) uint8, the record of each term.
    """

    parts: NDArray[np.uint16]
    chunks: NDArray[np.int32]
    starts: NDArray[np.int64]
    chunk_rows: NDArray[np.void]
    chunk_numbers: Chunks
    owners: NDArray[np.int32]
    term_records: NDArray[np.uint8]

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> RecordTables:
        """Return the records from the arrays of serving tables."""
        kind = Chunks
        return cls(
            parts=arrays["parts"],
            chunks=arrays["chunks"],
            starts=arrays["starts"],
            chunk_rows=arrays["chunk_rows"].view(CHUNK_ROW).reshape(-1),
            chunk_numbers=kind(*(arrays[f"chunk_{name}"] for name in kind._fields)),
            owners=arrays["owners"],
            term_records=arrays["term_records"],
        )


class StreamedScene:
    """A scene that is ready to be sent; `StreamedScene.open` opens one from a package.

    Args:
        source: The open source; none of its records is read.
        tables: Its serving tables.
        max_cache_bytes: Most bytes of decoded sets and candidates of cells to keep; the last is kept in any case.
        quality: How records were rounded when the tables were made.

    Attributes:
        source: The open source.
        header: The WELCOME message, the same for every client.
        about: Content of the WELCOME message.
        records: The records of the scene.
        index: The scene as planners see it.
        candidates: Candidates of each cell, shared by all planners.

    Raises:
        FormatError: If the visible sets of the source are damaged.
        ProtocolError: If the header is damaged.
    """

    def __init__(
        self,
        source: SceneSource,
        tables: SceneTables,
        *,
        max_cache_bytes: int = 512 << 20,
        quality: Quality | None = None,
    ) -> None:
        facts = tables.facts
        self.source = source
        self._pixel: float = facts["pixel"]
        self._quality = quality
        self.header = base64.b64decode(facts["welcome"])
        self.about = SceneHeader.parse(self.header)
        self.records = RecordTables.from_arrays(tables.arrays)
        cache: Cache[Any] = Cache(max_cache_bytes, keep_last=True)
        self.index = _index_of(source, tables, self.about, cache)
        found = CandidateTables.from_arrays(tables.arrays, TableNumbers.from_dict(facts["numbers"]))
        self.candidates = CandidateIndex(self.index, cache=cache, tables=found)

    @classmethod
    def open(
        cls,
        scene: SceneSource | Package | str | PathLike[str],
        *,
        max_cache_bytes: int = 512 << 20,
        pixel: float = 2e-3,
        quality: Quality | None = None,
    ) -> StreamedScene:
        """Read all records of a scene and compute its tables in memory.

        Args:
            scene: An open package or source, which the caller closes, or the folder of a package. A package without
                visible sets becomes one cell that sees everything.
            max_cache_bytes: Most bytes of decoded sets and candidates of cells to keep; the last is kept in any case.
            pixel: Angle of a pixel of the clients, radians.
            quality: How to round records before they are sent; None means not at all.

        Raises:
            FormatError: If the folder is not a package, or is damaged.
            OSError: If the folder cannot be opened.
        """
        _check.positive_int("max_cache_bytes", max_cache_bytes, at_least=0)
        source = as_source(scene)
        source.set_files(verify=True)
        tables = make_tables(source, pixel=pixel, quality=quality)
        return cls(source, tables, max_cache_bytes=max_cache_bytes, quality=quality)

    def with_index(self, index: SceneIndex, *, max_cache_bytes: int = 512 << 20) -> StreamedScene:
        """Return the same scene with a different index of the same Gaussians, and a cache of its own.

        Args:
            index: The index.
            max_cache_bytes: Most bytes of candidates of cells to keep; the last is kept in any case.
        """
        if len(index) != len(self):
            raise ValueError(f"index: expected one of {len(self):,} Gaussians, got {len(index):,}")
        other = copy.copy(self)
        other.index = index
        stored = self.candidates.tables.numbers.stored
        cache: Cache[Any] = Cache(max_cache_bytes, keep_last=True)
        other.candidates = CandidateIndex(index, pixel=self._pixel, stored=stored, cache=cache)
        return other

    def sending(self, terms: str) -> StreamedScene:
        """Return the same scene with another choice of the terms that are sent.

        Args:
            terms: One of `TERMS`. "pose": those that change the image for the eye. "cell": all that are active
                somewhere in the cell of the eye (SRBF-Gaussian, section 6.2).
        """
        if _check.one_of("terms", terms, TERMS) == "pose" or self.index.cones is None:
            return self
        return self.with_index(replace(self.index, cones=None))

    @property
    def coding(self) -> Coding:
        """The code of the records."""
        return self.about.coding

    @property
    def contents(self) -> Contents:
        """The records of the source, rounded if there is a quality; decoded at each access if not in memory."""
        contents = self.source.read_contents()
        return contents if self._quality is None else coarsen(contents, self._quality)[0]

    def __len__(self) -> int:
        """Return N, the number of Gaussians."""
        return self.about.gaussians

    def __repr__(self) -> str:
        return f"StreamedScene({self.source!r}, {len(self.index.grid):,} cells)"

    @property
    def most_hello(self) -> int:
        """Most bytes of a HELLO for this scene, with any holdings; a TOKEN is never longer."""
        return 4096 + Holdings.most_bytes(self.about.gaussians, self.about.terms)


def _index_of(source: SceneSource, tables: SceneTables, about: SceneHeader, cache: Cache[Any]) -> SceneIndex:
    """Return the index of a scene from its tables; decoded visible sets go to `cache`."""
    n = about.gaussians
    a = tables.arrays
    cones = None
    if tables.facts["has_cones"]:
        cones = TermCones.trusted(*(a[f"record_{name}"] for name in ("centers", "places", "cosines", "widths")))
    grid = source.cells_from(a)
    return SceneIndex.trusted(
        level_counts=tuple(tables.facts["level_counts"]),
        means=a["bodies"][:3, :n].T,
        radii=a["bodies"][3, :n],
        areas=a["record_areas"],
        importance=a["importance"],
        gaussian_bytes=np.broadcast_to(a["record_sizes"], (n,)),
        first=a["first"],
        last=a["last"],
        level_names=about.names,
        term_offsets=a["record_term_offsets"],
        term_bytes=a["record_term_sizes"],
        replacement_offsets=a["replacement_offsets"],
        replacement_ids=a["link_ids"],
        class_weights=a["class_weights"],
        grid=grid,
        sets=source.sets(grid, cache, a),
        active=source.active(),
        cones=cones,
    )
