"""The store of active terms: for each cell of a PVS the terms that some eye in it may need (equation 7 of the paper).

One Arrow IPC file beside the store of visible sets, a row for each cell: a roaring bitmap of term ids in the portable
format, under a checksum. Term ids are those of `SrbfColors`, Gaussian by Gaussian. Opening reads a few kilobytes; a
cell is read, and checked, when it is asked for.
"""

from __future__ import annotations

import hashlib
import json
import os
import struct
import threading
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from os import PathLike
from types import TracebackType
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pyroaring import BitMap

from gsvis import _check
from gsvis.color.srbf import SrbfColors
from gsvis.color.variants import VARIANTS
from gsvis.errors import FormatError
from gsvis.files.arrow import FAULTS, count_uncompressed_bytes
from gsvis.files.atomic import atomic_path
from gsvis.files.fields import Fields, parse_object
from gsvis.files.limits import Budget, open_regular
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
_REMEDY = "the file is damaged: copy or build it again"
_AGAIN = "build the active terms again"


@dataclass(frozen=True)
class ActiveTermsInfo:
    """What a store of active terms was made from.

    Attributes:
        cells: C.
        terms: T of the whole scene.
        gaussians: N.
        variant: How the colors are split.
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
    """How many terms a cell needs.

    Attributes:
        active: Active terms.
        of_visible: Their share of the terms of the Gaussians that the cell sees; 0 where there are none.
        of_all: Their share of all terms of the scene; 0 where there are none.
    """

    active: int
    of_visible: float
    of_all: float


class ActiveTerms:
    """An open store; `ActiveTerms.open` or `gsvis.prepare.build_active_terms` makes one. Safe to share between threads.

    Attributes:
        path: The file.
        info: What it was made from.
    """

    def __init__(self, path: str | PathLike[str]) -> None:
        """Open a file without a look at what it belongs to; see `open`."""
        self.path = _check.path("path", path)
        self._lock = threading.Lock()
        self._held: tuple[int, Any] | None = None  # the group read last
        self._stream: Any = None
        self._messages: list[Any] = []  # of the groups up to the highest that was asked for
        with open_regular(self.path) as file:  # a missing file is told as such, not by Arrow
            self._budget_bytes = os.fstat(file.fileno()).st_size
        self._source = self._guard("", lambda: pa.memory_map(str(self.path), "r"))
        try:
            self._reader = self._guard("", lambda: pa.ipc.open_file(self._source))
            self.info = self._read_info()
            groups = -(-self.info.cells // _GROUP)
            if self._reader.num_record_batches != groups:
                raise self._fault("footer", f"{groups} groups of cells", f"{self._reader.num_record_batches}")
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
            scene: The scene it should belong to, compared by content; None compares nothing. So with the other two.
            colors: Its colors.
            sets: Its visible sets.

        Raises:
            FormatError: If the file is no such store, damaged, cut, of a newer version, or made from something else.
            OSError: If it cannot be opened.
        """
        store = cls(path)
        try:
            store.check(scene=scene, colors=colors, sets=sets)
        except BaseException:
            store.close()
            raise
        return store

    def close(self) -> None:
        """Let go of the file; no query works afterward."""
        with self._lock:
            self._held, self._stream = None, None
            self._messages.clear()
            self._source.close()

    def __enter__(self) -> ActiveTerms:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __len__(self) -> int:
        """C, the number of cells."""
        return self.info.cells

    def __repr__(self) -> str:
        told = f"{self.info.terms:,} terms, {len(self):,} cells, epsilon {self.epsilon:g}"
        return f"ActiveTerms({told}, {self.path.name})"

    @property
    def epsilon(self) -> float:
        """Contribution above which a term is active."""
        return self.info.epsilon

    def active(self, cell: int) -> BitMap:
        """The terms that some eye in a cell may need.

        Args:
            cell: Its number in the grid of the visible sets.

        Returns:
            A bitmap of term ids that the caller may change.

        Raises:
            ValueError: If there is no such cell, or the store was closed.
            FormatError: If the file is damaged there.
        """
        return self._row(cell)[0]

    def active_ids(self, cell: int) -> NDArray[np.int64]:
        """`active` as rising ids."""
        return np.array(self.active(cell).to_array(), np.int64)

    def difference(self, cell: int, held: Iterable[int]) -> BitMap:
        """The terms that a cell needs and a client does not hold yet; a bitmap of what it holds is quickest."""
        return self.active(cell) - (held if isinstance(held, BitMap) else BitMap(held))

    def share(self, cell: int) -> ActiveShare:
        """How many of the terms of the scene, and of the Gaussians it sees, a cell needs."""
        found, of_visible = self._row(cell)
        count = len(found)
        return ActiveShare(count, count / max(1, of_visible), count / max(1, self.info.terms))

    def check(
        self, *, scene: Gaussians | None = None, colors: SrbfColors | None = None, sets: VisibilityStore | None = None
    ) -> None:
        """Nothing, if the store was made from these.

        Raises:
            FormatError: If it was made from others.
        """
        for name, told, made, given in (
            ("scene", "scene", self.info.scene, None if scene is None else scene_hash(scene)),
            ("colors", "colors", self.info.colors, None if colors is None else colors_hash(colors)),
            ("sets", "visible sets", self.info.sets, None if sets is None else sets_hash(sets)),
        ):
            if given is not None and given != made:
                wanted, got = f"active terms of {told} {given[:12]}...", f"those of {made[:12]}..."
                raise FormatError(
                    self.path, name, wanted, got, f"open it with the {told} it was built for, or {_AGAIN}"
                )

    def verify(self, *, progress: Progress = silent) -> None:
        """Read and decode everything.

        Args:
            progress: Called with stage "verify".

        Raises:
            FormatError: If anything is damaged; names the first place.
        """
        progress("verify", 0, len(self))
        for cell in range(len(self)):
            self._row(cell)
            progress("verify", cell + 1, len(self))

    def _row(self, cell: int) -> tuple[BitMap, int]:
        """Active terms of a cell, and the number of terms of the Gaussians that it sees."""
        if isinstance(cell, bool) or not isinstance(cell, int | np.integer) or not 0 <= cell < len(self):
            raise ValueError(f"cell: expected a number in [0, {len(self) - 1}], got {cell!r}")
        where, group, place = f"cell {cell}", int(cell) // _GROUP, int(cell) % _GROUP
        batch = self._batch(group, where)
        number, count, of_visible, crc, data = (batch.column(k)[place].as_py() for k in range(len(_SCHEMA)))
        if number != cell or crc != zlib.crc32(data, zlib.crc32(_CRC.pack(number, count, of_visible))):
            raise self._fault(where, "terms that fit their checksum", "others")
        try:
            found = BitMap.deserialize(data)
        except (ValueError, IndexError) as error:
            raise self._fault(where, "a roaring bitmap", f"other bytes ({error})") from error
        if len(found) != count or count > of_visible or (count and found.max() >= self.info.terms):
            raise self._fault(where, f"{count} of {of_visible} terms below {self.info.terms}", "others")
        return found, of_visible

    def _batch(self, group: int, where: str) -> Any:
        """A group of cells, decompressed."""
        with self._lock:
            if self._source.closed:
                raise ValueError("store: expected an open one, got one that was closed; open it again")
            if self._held is None or self._held[0] != group:

                def read() -> Any:
                    message = self._message(group)
                    Budget(self.path, self._budget_bytes).claim(count_uncompressed_bytes(message), where)
                    batch = pa.ipc.read_record_batch(message, self._reader.schema)
                    batch.validate(full=True)
                    return batch

                batch = self._guard(where, read)
                rows = min(_GROUP, self.info.cells - group * _GROUP)
                if batch.num_rows != rows or any(batch.column(k).null_count for k in range(len(_SCHEMA))):
                    raise self._fault(where, f"a group of {rows} cells without gaps", f"{batch.num_rows} rows")
                self._held = group, batch
            return self._held[1]

    def _message(self, group: int) -> pa.Message:
        """The record batch of a group, not decompressed."""
        if self._stream is None:
            self._source.seek(0)
            self._stream = pa.ipc.MessageReader.open_stream(self._source.read_buffer().slice(8))
            self._stream.read_next_message()  # the schema
        while len(self._messages) <= group:
            message = self._stream.read_next_message()
            if message.type != "record batch":
                raise ValueError(f"expected a record batch, got a {message.type} message")
            self._messages.append(message)
        return self._messages[group]

    def _read_info(self) -> ActiveTermsInfo:
        metadata = self._reader.schema.metadata or {}
        data, crc = metadata.get(b"gsvis"), metadata.get(b"gsvis-crc32")
        if data is None or crc is None:
            raise FormatError(
                self.path, "schema", "a store of active terms", "another Arrow file", "give one that gsvis has written"
            )
        if crc != _crc_text(data):
            raise self._fault("schema", "metadata that fit their checksum", "others")
        fields = parse_object(self.path, data)
        if fields.raw("format") != FORMAT:
            raise self._fault("format", repr(FORMAT), repr(fields.raw("format"))[:60])
        version = fields.integer("version", 1, 1 << 31)
        if version != VERSION:
            raise FormatError(self.path, "version", f"{VERSION}", f"{version}", f"update gsvis, or {_AGAIN}")
        if not self._reader.schema.equals(_SCHEMA):
            raise self._fault("schema", "columns " + ", ".join(_SCHEMA.names), "others")
        return self._info_of(fields)

    def _info_of(self, fields: Fields) -> ActiveTermsInfo:
        def text(key: str) -> str:
            value = fields.raw(key)
            if not isinstance(value, str):
                raise self._fault(key, "text", repr(value)[:60])
            return value

        epsilon = fields.number("epsilon")
        if text("variant") not in VARIANTS or epsilon < 0.0:
            raise self._fault("variant, epsilon", "a known variant and a threshold", f"{text('variant')!r}, {epsilon}")
        return ActiveTermsInfo(
            fields.integer("cells", 1, 1 << 31), fields.integer("terms", 0, (1 << 32) - 1),
            fields.integer("gaussians", 0, (1 << 31) - 1), text("variant"), epsilon, text("provenance"),
            fields.raw("weighted") is True, text("scene"), text("colors"), text("sets"),
        )  # fmt: skip

    def _guard(self, where: str, read: Any) -> Any:
        """What `read` gives; what Arrow says of bytes that are not its own becomes a FormatError."""
        try:
            return read()
        except (*FAULTS, StopIteration) as error:  # Arrow has many words for it
            first = (str(error).splitlines() or [type(error).__name__])[0][:120]
            raise self._fault(where, "an Arrow IPC file", f"other bytes ({first})") from error

    def _fault(self, where: str, expected: str, got: str) -> FormatError:
        return FormatError(self.path, where, expected, got, _REMEDY)


def write_active_terms(
    path: str | PathLike[str], info: ActiveTermsInfo, cells: Iterable[tuple[NDArray[np.uint32], int]]
) -> None:
    """Write a store; it appears whole or not at all.

    Args:
        path: The file.
        info: What it is made from.
        cells: For each cell the rising ids of its active terms, and the number of terms of the Gaussians it sees.

    Raises:
        OSError: If the file cannot be written; what stood at the path before stays.
    """
    text = json.dumps({"format": FORMAT, "version": VERSION, **asdict(info)}, sort_keys=True, allow_nan=False).encode()
    schema = _SCHEMA.with_metadata({b"gsvis": text, b"gsvis-crc32": _crc_text(text)})
    with atomic_path(path) as partial:
        options = pa.ipc.IpcWriteOptions(compression="zstd")
        with pa.OSFile(str(partial), "wb") as sink, pa.ipc.new_file(sink, schema, options=options) as writer:
            for rows in _groups(cells):
                columns = zip(*rows, strict=True)
                arrays = [pa.array(list(column), field.type) for column, field in zip(columns, schema, strict=True)]
                writer.write_batch(pa.record_batch(arrays, schema=schema))


def _groups(cells: Iterable[tuple[NDArray[np.uint32], int]]) -> Iterator[list[tuple[int, int, int, int, bytes]]]:
    """Rows of the file, as many as go into a group."""
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
    """SHA-256 over variant, base colors and terms, as 64 hexadecimal digits."""
    digest = hashlib.sha256(b"gsvis colors 1\n%s\n" % colors.variant.encode())
    for name in ("base", "scales", "axes", "offsets", "functions", "centers", "decays", "intensities"):
        array = np.ascontiguousarray(getattr(colors, name))
        little = array.astype(array.dtype.newbyteorder("<"), copy=False)
        digest.update(f"{name} {array.shape}\n".encode())
        digest.update(little.tobytes())
    return digest.hexdigest()


def sets_hash(store: VisibilityStore) -> str:
    """SHA-256 over scene, tau and cells of a store, and how many Gaussians each cell sees, as hexadecimal digits."""
    grid = store.grid
    digest = hashlib.sha256(f"gsvis sets 1\n{store.info.scene} {len(grid)} {grid.shape}\n".encode())
    digest.update(np.concatenate([grid.origin, [grid.cell_size, store.tau]]).astype("<f8").tobytes())
    digest.update(grid.coords.astype("<i4").tobytes())
    digest.update(store.visible_counts.astype("<i8").tobytes())
    return digest.hexdigest()


def _crc_text(data: bytes) -> bytes:
    return f"{zlib.crc32(data):08x}".encode()
