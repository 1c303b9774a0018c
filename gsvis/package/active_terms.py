"""The store of active terms: for each cell of a PVS, the terms that an eye in it may need (equation 7 of the paper).

The store is one Arrow IPC file with a row for each cell. A row holds a roaring bitmap of term ids in the portable
format, and a checksum. Term ids are those of `SrbfColors`, Gaussian by Gaussian. Opening reads a few kilobytes. A cell
is read and checked on first use.
"""

from __future__ import annotations

import hashlib
import struct
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from os import PathLike
from types import TracebackType

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pyroaring import BitMap

from gsvis import _check
from gsvis.color.srbf import SrbfColors
from gsvis.color.variants import VARIANTS, variant
from gsvis.errors import FormatError
from gsvis.files.arrow import ArrowFile, write_arrow
from gsvis.files.cache import Cache
from gsvis.files.fields import Fields
from gsvis.files.limits import DAMAGED, Budget
from gsvis.progress import Progress, silent
from gsvis.pvs.store import VisibilityStore
from gsvis.scene.content import scene_hash
from gsvis.scene.gaussians import Gaussians

__all__ = ["ActiveShare", "ActiveTerms", "ActiveTermsInfo", "colors_hash", "sets_hash", "write_active_terms"]

FORMAT = "gsvis active terms"
VERSION = 1

_GROUP = 8  # cells that are compressed together
_CRC = struct.Struct("<III")
_SCHEMA = pa.schema(
    [
        pa.field("cell", pa.uint32(), nullable=False),
        pa.field("active", pa.uint32(), nullable=False),
        pa.field("of_visible", pa.uint32(), nullable=False),
        pa.field("crc", pa.uint32(), nullable=False),
        pa.field("terms", pa.large_binary(), nullable=False),
    ]
)
_AGAIN = "build the active terms again"


@dataclass(frozen=True)
class ActiveTermsInfo:
    """The sources of a store of active terms.

    Attributes:
        cells: C, the number of cells.
        terms: T, the number of terms of the whole scene.
        gaussians: N, the number of Gaussians.
        variant: Variant of the colors.
        epsilon: Contribution above which a term is active.
        provenance: Where epsilon comes from.
        weighted: Whether contributions were multiplied by blending weights.
        scene: `scene_hash` of the scene.
        colors: `colors_hash` of the colors.
        sets: `sets_hash` of the visible sets.
    """

    cells: int
    terms: int
    gaussians: int
    variant: str
    epsilon: float
    provenance: str
    weighted: bool
    scene: str
    colors: str
    sets: str


@dataclass(frozen=True)
class ActiveShare:
    """The number of terms that a cell needs, and their shares.

    Attributes:
        active: Number of active terms.
        of_visible: Active terms over the terms of the Gaussians that the cell sees; 0 if these have no terms.
        of_all: Active terms over all terms of the scene; 0 if the scene has no terms.
    """

    active: int
    of_visible: float
    of_all: float


class ActiveTerms:
    """An open store, from `ActiveTerms.open` or `gsvis.prepare.build_active_terms`. Threads may share it.

    Attributes:
        path: The file.
        info: Sources of the store.
    """

    def __init__(self, path: str | PathLike[str]) -> None:
        """Open a file without checking its sources; see `open`."""
        self.path = _check.path("path", path)
        self._cache: Cache[pa.RecordBatch] = Cache(max_items=1)  # the last group read
        self._file = ArrowFile(self.path, FORMAT, VERSION, seal="header")
        try:
            self._file.check_schema(_SCHEMA)
            self.info = self._info_from(self._file.header)
            groups = -(-self.info.cells // _GROUP)
            if self._file.num_batches != groups:
                raise self._fault("footer", f"{groups} groups of cells", f"{self._file.num_batches}")
        except BaseException:
            self.close()
            raise

    @classmethod
    def open(
        cls,
        path: str | PathLike[str],
        *,
        scene: Gaussians | None = None,
        colors: SrbfColors | None = None,
        sets: VisibilityStore | None = None,
    ) -> ActiveTerms:
        """Open a store.

        Args:
            path: The file.
            scene: The scene that the store must belong to, compared by content; None skips this check.
            colors: The colors that it must belong to, compared by content; None skips this check.
            sets: The visible sets that it must belong to, compared by content; None skips this check.

        Raises:
            FormatError: If the file is not such a store, damaged, cut, of a newer version, or made from different
                sources.
            OSError: If the file cannot be opened.
        """
        store = cls(path)
        try:
            store.check(scene=scene, colors=colors, sets=sets)
        except BaseException:
            store.close()
            raise
        return store

    def close(self) -> None:
        """Close the file; no query works afterward."""
        self._cache.clear()
        self._file.close()

    def __enter__(self) -> ActiveTerms:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __len__(self) -> int:
        """Return C, the number of cells."""
        return self.info.cells

    def __repr__(self) -> str:
        text = f"{self.info.terms:,} terms, {len(self):,} cells, epsilon {self.epsilon:g}"
        return f"ActiveTerms({text}, {self.path.name})"

    @property
    def epsilon(self) -> float:
        """Contribution above which a term is active."""
        return self.info.epsilon

    def active(self, cell: int) -> BitMap:
        """Return the terms that an eye in a cell may need.

        Args:
            cell: Number of the cell in the grid of the visible sets.

        Returns:
            A bitmap of term ids that the caller may change.

        Raises:
            ValueError: If there is no such cell, or the store was closed.
            FormatError: If the file is damaged there.
        """
        return self._row(cell)[0]

    def active_ids(self, cell: int) -> NDArray[np.int64]:
        """Return `active` as ascending ids."""
        return np.array(self.active(cell).to_array(), np.int64)

    def difference(self, cell: int, held: Iterable[int]) -> BitMap:
        """Return the active terms of a cell that are not in `held`; a `BitMap` of held terms is fastest."""
        return self.active(cell) - (held if isinstance(held, BitMap) else BitMap(held))

    def share(self, cell: int) -> ActiveShare:
        """Return how many terms a cell needs, and their shares."""
        found, of_visible = self._row(cell)
        count = len(found)
        return ActiveShare(count, count / max(1, of_visible), count / max(1, self.info.terms))

    def check(
        self, *, scene: Gaussians | None = None, colors: SrbfColors | None = None, sets: VisibilityStore | None = None
    ) -> None:
        """Check that the store was made from these sources; None skips a source.

        Raises:
            FormatError: If a source differs.
        """
        for name, part, made, given in (
            ("scene", "scene", self.info.scene, None if scene is None else scene_hash(scene)),
            ("colors", "colors", self.info.colors, None if colors is None else colors_hash(colors)),
            ("sets", "visible sets", self.info.sets, None if sets is None else sets_hash(sets)),
        ):
            if given is not None and given != made:
                wanted = f"active terms of {part} {given[:12]}..."
                got = f"those of {made[:12]}..."
                raise FormatError(
                    self.path, name, wanted, got, f"open it with the {part} it was built for, or {_AGAIN}"
                )

    def verify(self, *, progress: Progress = silent) -> None:
        """Read and decode the whole file.

        Args:
            progress: Called with stage "verify".

        Raises:
            FormatError: If anything is damaged; the error names the first damaged place.
        """
        progress("verify", 0, len(self))
        for cell in range(len(self)):
            self._row(cell)
            progress("verify", cell + 1, len(self))

    def _row(self, cell: int) -> tuple[BitMap, int]:
        """Return the active terms of a cell, and the number of terms of the Gaussians that it sees."""
        if isinstance(cell, bool) or not isinstance(cell, int | np.integer) or not 0 <= cell < len(self):
            raise ValueError(f"cell: expected a number in [0, {len(self) - 1}], got {cell!r}")
        where = f"cell {cell}"
        group = int(cell) // _GROUP
        place = int(cell) % _GROUP
        batch = self._batch(group, where)
        number, count, of_visible, crc, data = (batch.column(k)[place].as_py() for k in range(len(_SCHEMA)))
        if number != cell or crc != zlib.crc32(data, zlib.crc32(_CRC.pack(number, count, of_visible))):
            got = f"cell {number}" if number != cell else "terms that do not"
            raise self._fault(where, f"cell {cell} with terms that fit their checksum", got)
        try:
            found = BitMap.deserialize(data)
        except (ValueError, IndexError) as error:
            raise self._fault(where, "a roaring bitmap", f"bytes that are none ({error})") from error
        if len(found) != count or count > of_visible or (count and found.max() >= self.info.terms):
            got = f"{len(found)} up to {found.max()}" if found else "none"
            raise self._fault(where, f"{count} of {of_visible} terms below {self.info.terms}", got)
        return found, of_visible

    def _batch(self, group: int, where: str) -> pa.RecordBatch:
        """Return a decompressed group of cells."""
        if self._file.closed:
            raise ValueError("store: expected an open one, got one that was closed; open it again")
        batch = self._cache.find(group)
        if batch is None:
            batch = self._file.batch(group, Budget(self.path, self._file.nbytes), where)
            rows = min(_GROUP, self.info.cells - group * _GROUP)
            if batch.num_rows != rows:
                raise self._fault(where, f"a group of {rows} cells", f"{batch.num_rows} rows")
            self._cache.keep(group, batch)
        return batch

    def _info_from(self, fields: Fields) -> ActiveTermsInfo:
        """Return the sources from the header of the file; raise FormatError if a value is invalid."""

        def text(key: str) -> str:
            """Return a value that has to be text."""
            value = fields.raw(key)
            if not isinstance(value, str):
                raise self._fault(key, "text", repr(value)[:60])
            return value

        epsilon = fields.number("epsilon")
        if text("variant") not in VARIANTS or epsilon < 0.0:
            raise self._fault("variant, epsilon", "rgb or hsl, and a threshold", f"{text('variant')!r}, {epsilon}")
        return ActiveTermsInfo(
            cells=fields.integer("cells", 1, 1 << 31),
            terms=fields.integer("terms", 0, (1 << 32) - 1),
            gaussians=fields.integer("gaussians", 0, (1 << 31) - 1),
            variant=text("variant"),
            epsilon=epsilon,
            provenance=text("provenance"),
            weighted=fields.raw("weighted") is True,
            scene=text("scene"),
            colors=text("colors"),
            sets=text("sets"),
        )

    def _fault(self, where: str, expected: str, got: str) -> FormatError:
        return FormatError(self.path, where, expected, got, DAMAGED)


def write_active_terms(
    path: str | PathLike[str], info: ActiveTermsInfo, cells: Iterable[tuple[NDArray[np.uint32], int]]
) -> None:
    """Write a store atomically.

    Args:
        path: The file.
        info: Sources of the store.
        cells: For each cell, the ascending ids of its active terms and the number of terms of the Gaussians it sees.

    Raises:
        ValueError: If there is no such variant.
        OSError: If the file cannot be written; an older file at the path stays.
    """
    variant(info.variant)
    header = {"format": FORMAT, "version": VERSION, **asdict(info)}
    write_arrow(path, _SCHEMA, header, _batches(cells), seal="header")


def _batches(cells: Iterable[tuple[NDArray[np.uint32], int]]) -> Iterator[pa.RecordBatch]:
    """Yield the rows of the file as record batches, one group at a time."""
    for rows in _groups(cells):
        columns = zip(*rows, strict=True)
        arrays = [pa.array(list(column), field.type) for column, field in zip(columns, _SCHEMA, strict=True)]
        yield pa.record_batch(arrays, schema=_SCHEMA)


def _groups(cells: Iterable[tuple[NDArray[np.uint32], int]]) -> Iterator[list[tuple[int, int, int, int, bytes]]]:
    """Yield the rows of the file as tuples, one group at a time."""
    rows: list[tuple[int, int, int, int, bytes]] = []
    for cell, (found, of_visible) in enumerate(cells):
        bitmap = BitMap(found)
        bitmap.run_optimize()
        data = bytes(bitmap.serialize())
        crc = zlib.crc32(data, zlib.crc32(_CRC.pack(cell, len(found), of_visible)))
        rows.append((cell, len(found), of_visible, crc, data))
        if len(rows) == _GROUP:
            yield rows
            rows = []
    if rows:
        yield rows


def colors_hash(colors: SrbfColors) -> str:
    """Return the SHA-256 over variant, base colors and terms, as 64 hexadecimal digits."""
    digest = hashlib.sha256(b"gsvis colors 1\n%s\n" % colors.variant.encode())
    for name in ("base", "scales", "axes", "offsets", "functions", "centers", "decays", "intensities"):
        if name == "axes":  # colors of earlier versions had them; without this line their hashes would change
            digest.update(f"axes ({len(colors)}, 0, 3)\n".encode())
            continue
        array = np.ascontiguousarray(getattr(colors, name))
        little = array.astype(array.dtype.newbyteorder("<"), copy=False)
        digest.update(f"{name} {array.shape}\n".encode())
        digest.update(little.data if little.size else b"")
    return digest.hexdigest()


def sets_hash(store: VisibilityStore) -> str:
    """Return the SHA-256 over scene, tau, cells and visible counts of a store, as 64 hexadecimal digits."""
    grid = store.grid
    digest = hashlib.sha256(f"gsvis sets 1\n{store.info.scene} {len(grid)} {grid.shape}\n".encode())
    digest.update(np.concatenate([grid.origin, [grid.cell_size, store.tau]]).astype("<f8").tobytes())
    digest.update(grid.coords.astype("<i4").tobytes())
    digest.update(store.visible_counts.astype("<i8").tobytes())
    return digest.hexdigest()
