"""A package on disk, open for reading: records, levels, colors and visible sets of a scene.

Opening reads only the manifest. Each part is checked against its name when it is read; `verify` reads all parts. Ids
are places in the order of the package. Scene frame and units.
"""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cached_property
from os import PathLike
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.errors import FormatError, SceneError
from gsvis.files.cache import Cache
from gsvis.files.limits import Budget
from gsvis.files.output import TEMPORARY, output_errors
from gsvis.files.temporary import temporary_folder
from gsvis.package.active_terms import ActiveTerms
from gsvis.package.blocks import read_blocks
from gsvis.package.cell_terms import CellTerms
from gsvis.package.codec import ChunkTable, base_colors
from gsvis.package.contents import Contents, base_places
from gsvis.package.layout import RECORD_BYTES, RecordLayout, TermLayout
from gsvis.package.manifest import MANIFEST, Blob, Manifest
from gsvis.package.parts import PartFolder
from gsvis.package.sets import open_sets
from gsvis.progress import Progress, silent
from gsvis.pvs.store import VisibilityStore

__all__ = ["PARTS", "Package", "Verified", "columns_of"]

PARTS = "parts"
"""Name of the folder of parts."""

U8 = NDArray[np.uint8]
_REMEDY = "prepare the package again"
_TABLE: dict[str, type[np.generic]] = {
    **{f"origin_{axis}": np.float32 for axis in "xyz"},
    **{f"step_{axis}": np.float32 for axis in "xyz"},
    "low": np.int16,
    "stride": np.uint8,
    "count": np.uint16,
    "first_level": np.uint8,
    "last_level": np.uint8,
}
_BITS: dict[str, type[np.generic]] = {f"bits_{axis}": np.uint8 for axis in "xyz"}  # since version 3 of the format


@dataclass(frozen=True)
class Verified:
    """The result of `Package.verify`.

    Attributes:
        parts: Number of different parts.
        nbytes: Bytes of these parts and of the manifest.
        gaussians: N, the number of Gaussians.
        terms: T, the number of terms.
        cells: Cells of the visible sets; 0 without visible sets.
        strays: Number of files in the folder of parts that the manifest does not name.
    """

    parts: int
    nbytes: int
    gaussians: int
    terms: int
    cells: int
    strays: int


class Package:
    """An open package, from `Package.open` or `write_package`.

    Attributes:
        path: The folder.
        manifest: The parsed manifest.
    """

    def __init__(self, path: str | PathLike[str]) -> None:
        """Read the manifest; see `open`."""
        self.path = _check.path("path", path)
        if self.path.is_dir() and not (self.path / MANIFEST).is_file():
            got = "a folder without"
            remedy = _REMEDY
            if (self.path / "world.json").is_file():
                got = "a world"
                remedy = "give one of its tiles, which are in packages"
            raise FormatError(self.path, "", f"a package with a {MANIFEST}", got, remedy)
        self.manifest = Manifest.read(self.path / MANIFEST)
        self._parts = PartFolder(self.path / PARTS)
        self._opened = ExitStack()

    @classmethod
    def open(cls, path: str | PathLike[str]) -> Package:
        """Open a package.

        Args:
            path: Folder of the package.

        Raises:
            FormatError: If the folder is not a package, or the manifest is damaged or has an unsupported version.
            OSError: If the manifest cannot be opened.
        """
        return cls(path)

    def close(self) -> None:
        """Close the stores that this package opened."""
        self._opened.close()

    def __enter__(self) -> Package:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __len__(self) -> int:
        """Return N, the number of Gaussians of all levels together."""
        return self.manifest.gaussians

    def __repr__(self) -> str:
        m = self.manifest
        return f"Package({m.gaussians:,} Gaussians, {m.terms:,} terms, {len(m.names)} levels, {self.path.name})"

    @cached_property
    def contents(self) -> Contents:
        """All records, read and checked once; 16 bytes of memory a Gaussian and a few bytes a term.

        Raises:
            FormatError: If a part is missing, damaged, or inconsistent with the manifest.
        """
        m = self.manifest
        budget = self._budget()
        table, levels = self._read_chunks(budget)
        found = self._decode(m, table, levels, budget)
        members = [int(((found.first <= k) & (k <= found.last)).sum()) for k in range(len(m.names))]
        if members != list(m.counts):
            raise self._fault("levels", f"{m.counts} Gaussians", f"{members}")
        return found

    def part_of(self, gaussian: int) -> tuple[Contents, int]:
        """Return the records of the part that has a Gaussian, and the id of its first Gaussian; read nothing else.

        Raises:
            ValueError: If there is no such Gaussian.
            FormatError: If a part that is read is missing, damaged, or inconsistent with the manifest.
        """
        if not 0 <= gaussian < len(self):
            raise ValueError(f"gaussian: expected an id below {len(self):,}, got {gaussian}")
        m = self.manifest
        budget = self._budget()
        starts = np.cumsum([0, *(block.count for block in m.blocks)])
        k = int(np.searchsorted(starts, gaussian, "right")) - 1
        table, levels = self._read_chunks(budget)
        some = slice(*np.searchsorted(table.starts, starts[k : k + 2]).tolist())
        return self._decode(replace(m, blocks=(m.blocks[k],)), table[some], levels[some], budget), int(starts[k])

    @cached_property
    def visibility(self) -> VisibilityStore:
        """The store of visible sets; ids are places in the order of the package.

        Raises:
            SceneError: If the package has no visible sets.
            FormatError: If the store is damaged, or belongs to a different scene.
        """
        self.set_files(verify=True)
        return self.open_sets()

    def open_sets(self, cache: Cache[Any] | None = None, *, order: NDArray[np.int32] | None = None) -> VisibilityStore:
        """Open the visible sets in place; `close` closes them. Data is checked by the checksums of the store when read.

        Args:
            cache: Cache for decoded data; None means a new one.
            order: (N,) `VisibilityStore.order`, if it is known.

        Raises:
            SceneError: If the package has no visible sets.
            FormatError: If the store is damaged, or belongs to a different scene.
        """
        store = open_sets(self._parts.folder, self.manifest, cache, order=order, is_held=True)
        self._opened.callback(store.close)
        return store

    def set_files(self, *, verify: bool = False) -> list[Path]:
        """Return the files of the visible sets; empty without visible sets.

        Args:
            verify: Whether to read them and compare their content with their names; otherwise only their sizes.

        Raises:
            FormatError: If a file is missing or damaged.
        """
        blob = self.manifest.visibility
        if blob is None:
            return []
        check = self._parts.path_of if verify else self._parts.check_size
        return [check(part) for part in blob.parts]

    def check_parts(self) -> None:
        """Check that every part exists with the right size; read none of them.

        Raises:
            FormatError: If a part is missing, a link, or has a wrong size.
        """
        for part in self.manifest.parts():
            self._parts.check_size(part)

    def forget_records(self) -> None:
        """Free the memory of the records and of data decoded from them; they are read again when needed."""
        for name in ("contents", "active_terms"):
            self.__dict__.pop(name, None)

    @cached_property
    def epsilon(self) -> float | None:
        """Contribution above which a term is active in a cell; None if cells do not choose terms.

        Raises:
            FormatError: If the package has version 2 and its lists of active terms are damaged.
        """
        if self.manifest.version > 2 or self.manifest.active_terms is None:
            return self.manifest.info.epsilon
        return self._lists.epsilon

    @cached_property
    def active_terms(self) -> CellTerms | ActiveTerms:
        """The terms that each cell needs: lists in the package, or computed from the visible sets on request.

        Raises:
            SceneError: If the package has no visible sets, or its cells do not choose terms.
            FormatError: If a part is damaged.
        """
        if self.epsilon is None:
            raise SceneError(f"{self.path}: the package has no epsilon; prepare it with visibility")
        if self.manifest.version > 2 and self.manifest.active_terms is not None:
            self._lists.check(sets=self.visibility)
            return self._lists
        contents = self.contents
        return CellTerms(contents.gaussians(), contents.colors().dequantize(), self.visibility, self.epsilon)

    @cached_property
    def _lists(self) -> ActiveTerms:
        """The lists of active terms in the package, open until `close`."""
        file = self._join_blob(self.manifest.active_terms, "active.terms.arrow")
        return self._opened.enter_context(ActiveTerms(file))

    def verify(self, *, progress: Progress = silent) -> Verified:
        """Read, check and decode the whole package.

        Args:
            progress: Called with stage "verify", in parts.

        Raises:
            FormatError: If anything is damaged or missing; the error names the first damaged place.
        """
        m = self.manifest
        parts = sorted({part.name: part for part in m.parts()}.values(), key=lambda part: part.name)
        progress("verify", 0, len(parts))
        for k, part in enumerate(parts):
            self._parts.path_of(part)
            progress("verify", k + 1, len(parts))
        contents = self.contents
        try:
            contents.levels()
            contents.colors()
        except ValueError as error:
            raise self._fault("records", "records that can be drawn", str(error)) from error
        if not np.array_equal(base_colors(contents.records, contents.layout), base_places(contents.records, m.grids)):
            raise self._fault("records", "base colors within their tables", "places past the end")
        cells = 0
        if m.visibility is not None:
            self.visibility.verify()
            cells = len(self.visibility)
        if m.active_terms is not None:
            self._lists.verify()
        if m.active_terms is not None and m.version > 2:
            self._lists.check(sets=self.visibility)
        names = {part.name for part in parts}
        strays = sum(path.name not in names for path in self._parts.folder.iterdir()) if parts else 0
        size = (self.path / MANIFEST).stat().st_size
        return Verified(len(parts), size + sum(p.nbytes for p in parts), m.gaussians, m.terms, cells, strays)

    @property
    def _widths(self) -> tuple[int, int]:
        """Bytes of a Gaussian's record and of a term's record."""
        return RECORD_BYTES, TermLayout.from_grids(self.manifest.grids).nbytes

    def _read_chunks(self, budget: Budget) -> tuple[ChunkTable, U8]:
        """Return the rows of all chunks, and the first and last level (C, 2) of each."""
        m = self.manifest
        types = _TABLE if m.version == 2 else {**_TABLE, **_BITS}
        tables = [self._parts.read_columns(part, "chunks", types, rows, budget) for part, rows in m.tables]
        pairs = [np.stack([columns["first_level"], columns["last_level"]], axis=1) for columns in tables]
        levels = np.concatenate([np.zeros((0, 2), np.uint8), *pairs])
        wrong = (levels[:, 0] > levels[:, 1]) | (levels.max(axis=1, initial=0) >= len(m.names))
        if wrong.any():
            first, last = levels[int(np.argmax(wrong))].tolist()
            raise self._fault("chunks", f"levels in order, below {len(m.names)}", f"{first} to {last}")
        return ChunkTable.concatenate([self._parse_chunks(columns) for columns in tables]), levels

    def _decode(self, m: Manifest, table: ChunkTable, levels: U8, budget: Budget) -> Contents:
        """Return the records of the blocks of a manifest, from the rows and levels of their chunks."""
        starts = np.concatenate([[0], np.cumsum([block.count for block in m.blocks])]).astype(np.int64)
        blocks = read_blocks(self._parts, m, table, starts, budget)
        empty = [np.zeros((0, width), np.uint8) for width in self._widths]
        records, terms = (np.concatenate([empty[k], *(b[k] for b in blocks)]) for k in range(2))
        counts = np.concatenate([np.zeros(0, np.uint8), *(b[2] for b in blocks)])
        return Contents(m.names, table, levels, records, counts, terms, m.grids, starts, m.info.facts, m.limits)

    def _budget(self) -> Budget:
        """Return the memory budget of all parts, from their size on disk; a part that is named twice counts once."""
        different = {part.name: part for part in self.manifest.parts()}.values()
        files = [self._parts.folder / part.name for part in different]
        return Budget(self.path, sum(file.stat().st_size for file in files if file.is_file()))

    def _parse_chunks(self, columns: dict[str, Any]) -> ChunkTable:
        """Return the rows of chunks from the columns of a part; raise FormatError if a value is invalid."""
        origins = np.stack([columns[f"origin_{axis}"] for axis in "xyz"], axis=1)
        steps = np.stack([columns[f"step_{axis}"] for axis in "xyz"], axis=1)
        most = RecordLayout.from_variant(self.manifest.grids.variant).position
        bits = np.full(origins.shape, most, np.uint8)
        try:
            if self.manifest.version > 2:
                bits = np.stack([columns[name] for name in _BITS], axis=1)
                _check.in_range("bits", bits, 0, most)
            else:
                _check.in_range("steps", steps, 0.0, np.inf)
            return ChunkTable(origins, steps, columns["low"], columns["stride"], columns["count"], bits)
        except ValueError as error:
            raise self._fault("chunks", "valid rows", str(error)) from error

    def _join_blob(self, blob: Blob | None, name: str) -> Path:
        """Write a store in parts as one temporary file, and return its path; `close` removes the file."""
        folder = Path(self._opened.enter_context(temporary_folder()))
        with output_errors(folder, remedy=TEMPORARY):
            self._write_joined(blob, folder / name)
        return folder / name

    def _write_joined(self, blob: Blob | None, path: Path) -> None:
        """Write the parts of a store, one after the other, to a file."""
        if blob is None:
            raise SceneError(f"{self.path}: the package has no {path.name.split('.')[-2]}; prepare it with visibility")
        with path.open("wb") as file:
            for part in blob.parts:
                file.write(self._parts.content_of(part))

    def _fault(self, where: str, expected: str, got: str) -> FormatError:
        return FormatError(self.path, where, expected, got, _REMEDY)


def columns_of(table: ChunkTable, levels: U8) -> dict[str, NDArray[Any]]:
    """Return the columns of a part with rows of chunks; `levels` (C, 2) are the first and last level of each chunk."""
    values = [*table.origins.T, *table.steps.T, table.lows, table.strides, table.counts, *levels.T, *table.bits.T]
    return dict(zip([*_TABLE, *_BITS], values, strict=True))
