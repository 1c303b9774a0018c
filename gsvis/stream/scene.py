"""A package, decoded once for all sessions of a server. Threads may share it.

`to_arrays` takes a scene apart and `from_arrays` puts it together again without reading a record (`kept.py`).
"""

from __future__ import annotations

import base64
import copy
from collections.abc import Callable, Mapping
from functools import partial
from os import PathLike
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.abr.candidates import CandidateIndex
from gsvis.abr.cones import TermCones
from gsvis.abr.holdings import Holdings
from gsvis.abr.index import SceneIndex, SceneTerms
from gsvis.color.activation import Activation
from gsvis.color.srbf import unit_vectors
from gsvis.files.cache import Cache
from gsvis.package.codec import packed_bits
from gsvis.package.contents import Contents
from gsvis.package.layout import RECORD_BYTES
from gsvis.package.package import Package
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.codec import pack
from gsvis.pvs.store import VisibilityStore
from gsvis.stream._kernels import records
from gsvis.stream.batch import CHUNK_ROW
from gsvis.stream.coding import Coding, Quality, chunks_of, coarsen
from gsvis.stream.header import SceneHeader

__all__ = ["OwnIndex", "StreamedScene", "chunk_rows_of", "class_weights", "term_cones"]


class StreamedScene:
    """A package, ready to send; `StreamedScene.open` makes one.

    Attributes:
        package: The open package.
        coding: The code of the records.
        about: The content of WELCOME.
        header: The WELCOME message, the same for every client.
        index: What planners need to know of the scene.
        candidates: Candidates of each cell, shared by all planners.
        owners: (T,) int32, the Gaussian of each term.
        term_records: (T, B) uint8, the record of each term.
        chunks: (N,) int32, the chunk of each Gaussian.
        starts: (C + 1,) id of the first Gaussian of each chunk, and N.
        chunk_rows: (C,) of `CHUNK_ROW`, as sent.
        chunk_numbers: Rows of chunks, as the coder needs them.
        parts: (N, 16) uint16, the records of Gaussians, prepared to be coded many times.
    """

    def __init__(
        self,
        package: Package,
        *,
        max_cache_bytes: int = 512 << 20,
        pixel: float = 2e-3,
        quality: Quality | None = None,
    ) -> None:
        """Decode an open package; see `open`."""
        self.package = package
        self._pixel = pixel
        self._quality = quality
        steps = None
        contents = package.contents
        if quality is not None:
            contents, steps = coarsen(contents, quality)
        self._contents: Contents | None = contents
        self.coding = coding = Coding.from_contents(contents, steps)
        self.chunk_numbers = chunks_of(contents.table)
        self.parts = coding.split_records(contents)
        counts = contents.term_counts
        self.owners = np.repeat(np.arange(len(counts), dtype=np.int32), counts)
        self.term_records = contents.term_records
        self.chunks = contents.chunks
        self.starts = contents.table.starts
        self.chunk_rows = chunk_rows_of(contents)
        self.about = SceneHeader.from_manifest(package.manifest, coding)
        self.header = self.about.to_message()
        cache: Cache[Any] = Cache(max_cache_bytes, keep_last=True)
        self._plan(_scene_index(package, cache, coding.mean_bytes(contents)), cache)

    @classmethod
    def open(
        cls,
        package: Package | str | PathLike[str],
        *,
        max_cache_bytes: int = 512 << 20,
        pixel: float = 2e-3,
        quality: Quality | None = None,
    ) -> StreamedScene:
        """Open a package and read all its records; read no visible set yet.

        Args:
            package: An open package, which the caller closes, or its folder. A package without visible sets becomes one
                cell that sees everything.
            max_cache_bytes: Most bytes of decoded sets and candidates of cells to keep; the last is kept in any case.
            pixel: Angle of a pixel of the clients, radians.
            quality: How to round records before they are sent; None means not at all.

        Raises:
            FormatError: If the folder is not a package, or is damaged.
            OSError: If the folder cannot be opened.
        """
        _check.positive_int("max_cache_bytes", max_cache_bytes, at_least=0)
        found = package if isinstance(package, Package) else Package.open(package)
        return cls(found, max_cache_bytes=max_cache_bytes, pixel=pixel, quality=quality)

    def with_index(self, index: SceneIndex, *, max_cache_bytes: int = 512 << 20) -> StreamedScene:
        """Return the same scene, planned by another index of the same Gaussians, with a cache of its own.

        Args:
            index: The index.
            max_cache_bytes: Most bytes of candidates of cells to keep; the last is kept in any case.
        """
        if len(index) != len(self):
            raise ValueError(f"index: expected one of {len(self):,} Gaussians, got {len(index):,}")
        other = copy.copy(self)
        other._plan(index, Cache(max_cache_bytes, keep_last=True))
        return other

    def _plan(self, index: SceneIndex, cache: Cache[Any]) -> None:
        self.index = index
        stored = float(RECORD_BYTES), self.about.term_bits / 8
        self.candidates = CandidateIndex(index, pixel=self._pixel, stored=stored, cache=cache)

    def to_arrays(self) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """Return all arrays by name, and facts that JSON can hold, for `from_arrays`."""
        index = self.index
        grid = self.index.grid
        arrays, numbers = self.candidates.to_arrays()
        own = {
            "parts": self.parts,
            "chunks": self.chunks,
            "starts": self.starts,
            "term_records": self.term_records,
            "chunk_rows": self.chunk_rows.view(np.uint8),
            "first": index.first,
            "last": index.last,
            "importance": index.importance,
            "replacement_offsets": index.replacement_offsets,
            "class_weights": index.class_weights,
            **{f"chunk_{name}": array for name, array in self.chunk_numbers._asdict().items()},
        }
        facts = {
            "numbers": numbers,
            "welcome": base64.b64encode(self.header).decode(),
            "pixel": self._pixel,
            "box": [grid.origin.tolist(), grid.cell_size, grid.up.tolist()],  # read where there are no visible sets
            "level_counts": list(index.level_counts),
            "has_cones": index.cones is not None,
            "has_active": index.active is not None,
        }
        if isinstance(self.package, OwnIndex):
            own |= self.package.own_arrays()
        return arrays | own, facts

    @classmethod
    def from_arrays(
        cls,
        package: Package,
        arrays: Mapping[str, NDArray[Any]],
        facts: Mapping[str, Any],
        *,
        max_cache_bytes: int = 512 << 20,
        quality: Quality | None = None,
    ) -> StreamedScene:
        """Return the scene that `to_arrays` took apart. No record is read.

        Args:
            package: The same package, open.
            arrays: The arrays, such as views of a memory-mapped file.
            facts: The facts.
            max_cache_bytes: Most bytes of decoded sets and candidates of cells to keep; the last is kept in any case.
            quality: The quality of the scene.

        Raises:
            FormatError: If the visible sets of the package are damaged.
            ProtocolError: If the header is damaged.
        """
        self = cls.__new__(cls)
        a = arrays
        self.package = package
        self._pixel = facts["pixel"]
        self._quality = quality
        self._contents = None
        self.header = base64.b64decode(facts["welcome"])
        self.about = SceneHeader.parse(self.header)
        self.coding = self.about.coding
        self.parts = a["parts"]
        self.chunks = a["chunks"]
        self.starts = a["starts"]
        self.owners = a["owners"]
        self.term_records = a["term_records"]
        self.chunk_rows = a["chunk_rows"].view(CHUNK_ROW).reshape(-1)
        kind = records.Chunks
        self.chunk_numbers = kind(*(a[f"chunk_{name}"] for name in kind._fields))
        cache: Cache[Any] = Cache(max_cache_bytes, keep_last=True)
        self.index = _index_from(package, cache, self.about, arrays, facts)
        self.candidates = CandidateIndex.from_arrays(self.index, arrays, facts["numbers"], cache=cache)
        return self

    @property
    def contents(self) -> Contents:
        """The records of the package, rounded if there is a quality; decoded at each call if they are not in memory."""
        if self._contents is not None:
            return self._contents
        contents = type(self.package).open(self.package.path).contents
        return contents if self._quality is None else coarsen(contents, self._quality)[0]

    def __len__(self) -> int:
        """Return N, the number of Gaussians."""
        return self.about.gaussians

    def __repr__(self) -> str:
        return f"StreamedScene({self.package!r}, {len(self.index.grid):,} cells)"

    @property
    def most_hello(self) -> int:
        """Most bytes of a HELLO for this scene, whatever its client holds; enough for a TOKEN, too."""
        return 4096 + Holdings.most_bytes(self.about.gaussians, self.about.terms)


class EveryCell:
    """The sets of one cell that sees all Gaussians and has all terms active.

    Args:
        gaussians: N, the number of Gaussians.
        terms: T, the number of terms.
    """

    def __init__(self, gaussians: int, terms: int) -> None:
        self._gaussians = gaussians
        self._terms = terms

    def classes(self, cell: int) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
        """Return the ids of all Gaussians, and class 0 for each."""
        return np.arange(self._gaussians), np.zeros(self._gaussians, np.uint8)

    def visible_words(self, cell: int) -> NDArray[np.uint64]:
        """Return all Gaussians as a packed set."""
        return pack(np.arange(self._gaussians), self._gaussians)

    def active_ids(self, cell: int) -> NDArray[np.int64]:
        """Return the ids of all terms."""
        return np.arange(self._terms)


def class_weights(sets: VisibilityStore) -> NDArray[np.float32]:
    """Return the (K,) weight that stands for each class of a store: the geometric mean of its ends."""
    ends = [sets.class_interval(k) for k in range(len(sets.info.class_edges))]
    return np.array([np.sqrt(low * min(high, 1.0)) for low, high in ends], np.float32)


def term_cones(contents: Contents, epsilon: float) -> TermCones:
    """Return the directions in which each term of a package is active: its change of the color is above epsilon."""
    colors = contents.colors()
    exact = colors.dequantize()
    places = colors.centers[:, 0].astype(np.int64) << 16 | colors.centers[:, 1]
    _, first, found = np.unique(places, return_index=True, return_inverse=True)
    cosines = Activation(exact, np.zeros((len(contents), 3), np.float32), epsilon).least_cosines()
    centers = unit_vectors(exact.centers[first]).astype(np.float32)
    return TermCones(centers, found.astype(np.int32), cosines, 1.0 / exact.decays)


def chunk_rows_of(contents: Contents) -> NDArray[np.void]:
    """Return the (C,) rows of chunks, as sent."""
    table = contents.table
    rows = np.zeros(len(contents.table), CHUNK_ROW)
    for name, values in (
        ("origin", table.origins),
        ("step", table.steps),
        ("low", table.lows),
        ("count", table.counts),
        ("stride", table.strides),
        ("first_level", contents.chunk_levels[:, 0]),
        ("last_level", contents.chunk_levels[:, 1]),
        ("bits", packed_bits(table.bits)),
    ):
        rows[name] = values
    return rows


def _scene_index(package: Package, cache: Cache[Any], nbytes: tuple[float, float]) -> SceneIndex:
    """Return the index of a package for planners. Its visible sets are kept in `cache`.

    Args:
        package: An open package.
        cache: Keeps visible sets.
        nbytes: Bytes of a Gaussian and of a term.
    """
    contents = package.contents
    manifest = package.manifest
    if isinstance(package, OwnIndex):
        return package.scene_index(contents, nbytes, cache)
    if manifest.visibility is not None:
        sets = package.visibility
        sets.cache = cache
        active = None if package.epsilon is None else package.active_terms
        cones = None if active is None else term_cones(contents, active.epsilon)
        return SceneIndex.from_levels(
            contents.levels(),
            sets.grid,
            sets,
            terms=SceneTerms(contents.term_offsets, nbytes[1], active, cones),
            gaussian_bytes=nbytes[0],
            class_weights=class_weights(sets),
        )
    low, high = contents.gaussians().bounds(1.0) if len(contents) else (np.zeros(3), np.ones(3))
    side = max(float((high - low).max()), 1e-6)
    up = np.array(manifest.info.up)
    grid = CellGrid((low + high) / 2 - side / 2, side, (1, 1, 1), np.zeros((1, 3), np.int32), up)
    every = EveryCell(len(contents), len(contents.term_records))
    terms = SceneTerms(contents.term_offsets, nbytes[1], every)
    return SceneIndex.from_levels(contents.levels(), grid, every, terms=terms, gaussian_bytes=nbytes[0])


@runtime_checkable
class OwnIndex(Protocol):
    """A package that knows its cells and visible sets in a way of its own, such as a world."""

    def scene_index(self, contents: Contents, nbytes: tuple[float, float], cache: Cache[Any], /) -> SceneIndex:
        """Return what planners need to know of the scene."""
        ...

    def own_arrays(self) -> dict[str, NDArray[Any]]:
        """Return the arrays that `index_from` needs beside those of all scenes."""
        ...

    def index_from(self, arrays: Mapping[str, NDArray[Any]], cache: Cache[Any], /, **fields: Any) -> SceneIndex:
        """Return the index whose arrays were written before, from the fields of a `SceneIndex.trusted`."""
        ...


class _Later:
    """The active terms of a package, found only when somebody asks for them."""

    def __init__(self, package: Package) -> None:
        self._package = package

    def active_ids(self, cell: int) -> NDArray[np.int64]:
        return self._package.active_terms.active_ids(cell)


def _index_from(
    package: Package,
    cache: Cache[Any],
    about: SceneHeader,
    arrays: Mapping[str, NDArray[Any]],
    facts: Mapping[str, Any],
) -> SceneIndex:
    """Return the index of a package whose arrays were written before; its visible sets are kept in `cache`."""
    n = about.gaussians
    a = arrays
    sets: Any = EveryCell(n, about.terms)
    active: Any = sets
    make: Callable[..., SceneIndex] = SceneIndex.trusted
    grid: Any = None
    if isinstance(package, OwnIndex):
        make = partial(package.index_from, arrays, cache)
    elif package.manifest.visibility is None:
        origin, side, up = facts["box"]
        grid = CellGrid(np.asarray(origin), side, (1, 1, 1), np.zeros((1, 3), np.int32), np.asarray(up))
    else:
        sets = package.visibility
        sets.cache, grid, active = cache, sets.grid, _Later(package)
    cones = None
    if facts["has_cones"]:
        cones = TermCones.trusted(*(a[f"record_{name}"] for name in ("centers", "places", "cosines", "widths")))
    return make(
        level_counts=tuple(facts["level_counts"]),
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
        sets=sets,
        active=active if facts["has_active"] else None,
        cones=cones,
    )
