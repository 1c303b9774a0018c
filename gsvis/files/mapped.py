"""Store named arrays in a memory-mapped file: opening reads a few kilobytes, and pages are read on first use.

Such a file is a cache of what can be computed again. Opening it checks its head; `MappedArrays.check` reads its arrays
and checks those. Keep it in a folder that only its owner can write to. Processes that map the same file share its
memory.
"""

from __future__ import annotations

import json
import math
import mmap
import os
import re
import shutil
import struct
from collections.abc import Collection, Iterable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, BinaryIO, Protocol

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.errors import FormatError
from gsvis.files.atomic import atomic_path
from gsvis.files.fields import Fields, parse_object
from gsvis.files.limits import DAMAGED, open_regular
from gsvis.files.sums import PIECE, seal, unseal, word_sums

__all__ = [
    "ArrayFiles",
    "ArrayLists",
    "GrowingArrays",
    "MappedArrays",
    "give_back",
    "release_mapped",
    "resident_bytes",
    "write_arrays",
]

_MAGIC = b"\x93gsvis2\n"
_HEAD = struct.Struct("<8sQ")  # magic, bytes of the sealed JSON after it
_TYPE = re.compile(r"[<>|][biuf]\d{1,2}")
_PAGE = 1 << 12
_MOST_HEAD = 64 << 20
_MOST_BYTES = 1 << 50
_AT_ONCE = 64 * 8 * PIECE  # bytes that are checked at once


def write_arrays(path: str | os.PathLike[str], arrays: Mapping[str, NDArray[Any]], facts: Mapping[str, Any]) -> None:
    """Write arrays and facts as a file for `MappedArrays`, atomically.

    Args:
        path: The file.
        arrays: Contiguous arrays by name; whether each may be written to is kept. Names of the same array share bytes.
        facts: JSON values.

    Raises:
        OutputError: If the file cannot be written.
    """
    rows = []
    blocks = []
    places = dict[int, int]()
    end = 0
    for name, array in arrays.items():
        whole = np.ascontiguousarray(array)
        place = places.get(id(array))
        if place is None:
            place = places[id(array)] = end
            blocks.append(whole)
            end += -(-whole.nbytes // _PAGE) * _PAGE
        rows.append([name, whole.dtype.str, list(array.shape), place, bool(array.flags.writeable)])
    with atomic_path(path) as partial, partial.open("r+b") as file:
        _write_head(file, facts, rows, end)
        for block in blocks:
            file.write(block.reshape(-1).view(np.uint8).data)
            file.write(bytes(-file.tell() % _PAGE))
        _write_sums(file, end)


class GrowingArrays(Protocol):
    """Named arrays that grow piece by piece: in files (`ArrayFiles`) or in memory (`ArrayLists`)."""

    def append(self, name: str, piece: NDArray[Any]) -> None:
        """Add rows to an array; all of its pieces have one type and one shape of a row."""
        ...

    def count(self, name: str) -> int:
        """Return the current number of rows of an array; 0 without any piece."""
        ...

    def rows(self, name: str, first: int = 0, end: int | None = None) -> NDArray[Any]:
        """Return some rows of an array."""
        ...


class ArrayLists:
    """Arrays that grow piece by piece in memory."""

    def __init__(self) -> None:
        self._pieces: dict[str, list[NDArray[Any]]] = {}

    def append(self, name: str, piece: NDArray[Any]) -> None:
        """Add rows to an array; all of its pieces have one type and one shape of a row."""
        self._pieces.setdefault(name, []).append(np.ascontiguousarray(piece))

    def count(self, name: str) -> int:
        """Return the current number of rows of an array; 0 without any piece."""
        return sum(len(piece) for piece in self._pieces.get(name, []))

    def rows(self, name: str, first: int = 0, end: int | None = None) -> NDArray[Any]:
        """Return some rows of an array."""
        return self._join_pieces(name)[first:end]

    def arrays(
        self,
        *,
        joined: Mapping[str, Sequence[str]] | None = None,
        same: Mapping[str, str] | None = None,
        frozen: Collection[str] = (),
    ) -> dict[str, NDArray[Any]]:
        """Return all arrays by name, as `MappedArrays` returns those that `ArrayFiles.write` wrote.

        Args:
            joined: For each of these names, the arrays that become its rows; they have one length.
            same: For each of these names, the array that it is another name of.
            frozen: Names of read-only arrays.
        """
        rows = joined or {}
        inner = {part for parts in rows.values() for part in parts}
        found = {name: self._join_pieces(name) for name in self._pieces if name not in inner}
        found |= {name: np.stack([self._join_pieces(part) for part in parts]) for name, parts in rows.items()}
        found |= {name: found[of] for name, of in (same or {}).items()}
        return {name: _with_flag(array, name not in frozen) for name, array in found.items()}

    def _join_pieces(self, name: str) -> NDArray[Any]:
        """Return all rows of an array; join its pieces first."""
        pieces = self._pieces[name]
        if len(pieces) > 1:
            pieces[:] = [np.concatenate(pieces)]
        return pieces[0]


class ArrayFiles:
    """Arrays that grow piece by piece, each in a file of a folder, until they become one file for `MappedArrays`.

    Memory holds a piece. Use it in a `with` statement.

    Args:
        folder: An empty folder, which the caller removes.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._files: dict[str, BinaryIO] = {}
        self._rows: dict[str, tuple[np.dtype[Any], tuple[int, ...], int]] = {}

    def __enter__(self) -> ArrayFiles:
        return self

    def __exit__(self, *_: object) -> None:
        for file in self._files.values():
            file.close()

    def append(self, name: str, piece: NDArray[Any]) -> None:
        """Add rows to an array; all of its pieces have one type and one shape of a row."""
        whole = np.ascontiguousarray(piece)
        if name not in self._files:
            self._files[name] = (self._folder / f"{len(self._files)}").open("w+b")
            self._rows[name] = whole.dtype, whole.shape[1:], 0
        kind, shape, count = self._rows[name]
        assert whole.dtype == kind, name
        assert whole.shape[1:] == shape, name
        self._files[name].write(whole.reshape(-1).view(np.uint8).data)
        self._rows[name] = kind, shape, count + len(whole)

    def count(self, name: str) -> int:
        """Return the current number of rows of an array; 0 without any piece."""
        return self._rows[name][2] if name in self._rows else 0

    def rows(self, name: str, first: int = 0, end: int | None = None) -> NDArray[Any]:
        """Return some rows of an array, read from its file."""
        kind, shape, count = self._rows[name]
        size = kind.itemsize * int(np.prod(shape))
        end = count if end is None else end
        file = self._files[name]
        file.seek(size * first)
        data = file.read(size * (end - first))
        file.seek(0, os.SEEK_END)
        return np.frombuffer(data, kind).reshape(end - first, *shape)

    def write(
        self,
        path: str | os.PathLike[str],
        facts: Mapping[str, Any],
        *,
        joined: Mapping[str, Sequence[str]] | None = None,
        same: Mapping[str, str] | None = None,
        frozen: Collection[str] = (),
    ) -> None:
        """Write all arrays as one file, atomically; they are empty after that.

        Args:
            path: The file.
            facts: JSON values.
            joined: For each of these names, the arrays that become its rows; they have one length.
            same: For each of these names, the array that it is another name of.
            frozen: Names of read-only arrays.

        Raises:
            OutputError: If the file cannot be written.
        """
        joined = joined or {}
        same = same or {}
        inner = {part for parts in joined.values() for part in parts}
        groups = {name: [name] for name in self._rows if name not in inner} | {k: list(v) for k, v in joined.items()}
        rows = []
        places = dict[str, int]()
        end = 0
        for name, parts in groups.items():
            kind, shape, count = self._rows[parts[0]]
            whole = [count, *shape] if name not in joined else [len(parts), count, *shape]
            places[name] = end
            rows.append([name, kind.str, whole, end, name not in frozen])
            end += -(-kind.itemsize * int(np.prod(whole)) // _PAGE) * _PAGE
        known = {row[0]: row for row in rows}
        rows += [[name, *known[of][1:4], name not in frozen] for name, of in same.items()]
        with atomic_path(path) as partial, partial.open("r+b") as out:
            _write_head(out, facts, rows, end)
            for parts in groups.values():
                for part in parts:
                    self._files[part].seek(0)
                    shutil.copyfileobj(self._files[part], out, 1 << 20)
                    self._files[part].truncate(0)  # so that the disk never holds all of it twice
                out.write(bytes(-out.tell() % _PAGE))
            _write_sums(out, end)


class MappedArrays:
    """An open file of arrays.

    Args:
        path: The file.

    Attributes:
        path: The file.
        facts: The facts written with the arrays.
        arrays: The arrays by name, as views of the file. A write to one stays in this process.
        nbytes: Bytes of all arrays.

    Raises:
        FormatError: If the file is none of arrays, or is cut.
        OSError: If it cannot be opened.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = _check.path("path", path)
        with open_regular(self.path) as file:
            size = os.fstat(file.fileno()).st_size
            start, said = _read_head(self.path, file.read(_HEAD.size), file.read)
            self.nbytes = said.integer("bytes", 0, _MOST_BYTES)
            self.facts = said.child("facts").value
            expected = start + self.nbytes + len(seal(b"")) + 8 * -(-self.nbytes // (8 * PIECE))
            if size != expected:
                raise FormatError(self.path, "", f"{expected:,} bytes", f"{size:,}", DAMAGED)
            self._map = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY)
        self._start = start
        self.arrays = dict(self._view(row) for row in said.items("arrays"))

    def _view(self, row: Any) -> tuple[str, NDArray[Any]]:
        """Return the name of an array and its view; raise unless the file holds such an array."""
        try:
            name, kind, shape, place, writable = row
            if not isinstance(kind, str) or not _TYPE.fullmatch(kind):  # NumPy parses other text as Python
                raise ValueError(f"type {kind!r}")
            dtype = np.dtype(kind)
            good = isinstance(name, str) and type(writable) is bool
            good = good and type(place) is int and place >= 0 and place % _PAGE == 0
            good = good and all(type(length) is int and length >= 0 for length in shape)
            if not good or place + dtype.itemsize * math.prod(shape) > self.nbytes:
                raise ValueError(f"no array of {self.nbytes:,} bytes")
            flat = np.frombuffer(self._map, dtype, math.prod(shape), self._start + place)
            found = flat.reshape(shape)
        except (TypeError, ValueError, OverflowError) as error:
            raise FormatError(self.path, "arrays", "arrays in the file", repr(row)[:80], DAMAGED) from error
        found.flags.writeable = writable
        return name, found

    def check(self) -> None:
        """Read all arrays once to check them, then release their memory; call it before any array is written to.

        Raises:
            FormatError: If a byte of them has changed.
        """
        end = self._start + self.nbytes
        sums = unseal(self._map[end:])
        if sums is None:
            raise FormatError(
                self.path, f"byte {end:,}", "checksums of the arrays", "bytes that do not fit their own", DAMAGED
            )
        known = np.frombuffer(sums, np.uint64)
        for low in range(0, self.nbytes, _AT_ONCE):
            words = np.frombuffer(self._map, np.uint64, min(_AT_ONCE, self.nbytes - low) // 8, self._start + low)
            first = low // (8 * PIECE)
            found = word_sums(words)
            bad = np.flatnonzero(found != known[first : first + len(found)])
            if len(bad):
                place = self._start + low + 8 * PIECE * int(bad[0])
                k = int(bad[0])
                got = f"bytes with checksum {found[k]:016x}, not {known[first + k]:016x}"
                raise FormatError(self.path, f"byte {place:,}", "the bytes that were written", got, DAMAGED)
            give_back(self._map, self._start + low, self._start + low + 8 * len(words))

    def release(self, shares: Sequence[tuple[float, float]] | None = None) -> None:
        """Give back the memory of pages; a page that is touched again comes from the file.

        Safe at any time, also while other threads read: the content stays the same. Does nothing where the system has
        no such call.

        Args:
            shares: Which shares of each array, each from one number in [0, 1] to another; None means all.
        """
        if shares is None:
            give_back(self._map, 0, len(self._map))
            return
        for place, size in self._lines:
            for low, high in shares:
                give_back(self._map, place + int(size * low), place + int(size * high))

    @cached_property
    def _lines(self) -> list[tuple[int, int]]:
        """Places in the file of the lines of arrays along their longest axis, and their bytes."""
        base = np.frombuffer(self._map, np.uint8).ctypes.data
        found = set[tuple[int, int]]()
        for array in self.arrays.values():
            count = len(array) if array.ndim > 1 and len(array) < array.shape[1] else 1
            found |= {
                (array.ctypes.data - base + k * array.nbytes // count, array.nbytes // count) for k in range(count)
            }
        return sorted(found)


def release_mapped(values: Iterable[object]) -> None:
    """Give back the memory of read-only arrays that lie in mapped files, as `MappedArrays.release`.

    The pages at the ends of an array stay, and so does everything else.
    """
    for array in values:
        if not isinstance(array, np.ndarray):
            continue
        base: Any = array
        while isinstance(base, np.ndarray):
            base = base.base
        file = base.obj if isinstance(base, memoryview) else base
        if not isinstance(file, mmap.mmap) or array.flags.writeable or not array.flags.c_contiguous:
            continue
        place = array.ctypes.data - np.frombuffer(file, np.uint8).ctypes.data
        give_back(file, place, place + array.nbytes)


def resident_bytes() -> int:
    """Return the bytes of files in this process's memory, including shared ones; 0 if the system does not report it."""
    try:
        return int(Path("/proc/self/statm").read_bytes().split()[2]) * mmap.PAGESIZE
    except (OSError, IndexError, ValueError):
        return 0


def give_back(file: mmap.mmap, start: int, end: int) -> None:
    """Release the memory of the system's pages that lie within a range of bytes of a mapped file.

    The content stays: that of a private map as it is in the file, that of a shared one as it was written.
    """
    first = -(-start // mmap.PAGESIZE) * mmap.PAGESIZE
    size = end // mmap.PAGESIZE * mmap.PAGESIZE - first
    if size > 0 and hasattr(file, "madvise"):
        file.madvise(mmap.MADV_DONTNEED, first, size)


def _with_flag(array: NDArray[Any], is_writeable: bool) -> NDArray[Any]:
    """Return an array that may be written to, or a view that may not."""
    if is_writeable:
        return array if array.flags.writeable else array.copy()
    view: NDArray[Any] = array.view()
    view.flags.writeable = False
    return view


def _write_sums(file: BinaryIO, nbytes: int) -> None:
    """Read the arrays back, which are the last bytes of a file, and write their checksums behind them."""
    end = file.seek(0, os.SEEK_END)
    file.seek(end - nbytes)
    sums = [
        word_sums(np.frombuffer(file.read(min(_AT_ONCE, nbytes - k)), np.uint64)) for k in range(0, nbytes, _AT_ONCE)
    ]
    file.write(seal(np.concatenate([np.zeros(0, np.uint64), *sums]).tobytes()))


def _write_head(file: BinaryIO, facts: Mapping[str, Any], rows: list[list[Any]], nbytes: int) -> None:
    """Write the head, which comes before the arrays."""
    head = seal(json.dumps({"facts": facts, "arrays": rows, "bytes": nbytes}, allow_nan=False).encode())
    file.write(_HEAD.pack(_MAGIC, len(head)) + head)
    file.write(bytes(-file.tell() % _PAGE))


def _read_head(path: Path, head: bytes, read: Any) -> tuple[int, Fields]:
    """Return the place of the first array, and the content of the head."""
    magic, length = _HEAD.unpack(head) if len(head) == _HEAD.size else (b"", 0)
    sealed = read(length) if magic == _MAGIC and length <= _MOST_HEAD else b""
    data = unseal(sealed)
    if data is None:
        got = "a damaged head" if magic == _MAGIC else f"a file that begins {head[:8]!r}"
        raise FormatError(path, "byte 0", "a file of arrays", got, "remove it; it is made again")
    return -(-(_HEAD.size + length) // _PAGE) * _PAGE, parse_object(path, data)
