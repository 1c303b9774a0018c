"""Read and write Arrow IPC files for any Arrow client, with a gsvis header, a checksum, and bounded memory.

The schema's metadata holds a JSON header under `gsvis`, and one of two seals. A *whole* seal, under `checksum`, is the
CRC-32 of the file with zeros in place of the checksum's digits. It is checked when the file is opened. A *header*
seal, under `gsvis-crc32`, is the CRC-32 of the header alone. Opening then reads a few kilobytes for any file size.
Batches are read on demand, and the caller checks the checksum of each row. Only the schema is parsed before the seal is
checked. This module knows no columns.
"""

from __future__ import annotations

import json
import mmap
import os
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from gsvis import _check
from gsvis.errors import FormatError
from gsvis.files.atomic import atomic_path
from gsvis.files.fields import Fields, parse_object
from gsvis.files.limits import DAMAGED, Budget, open_regular

__all__ = ["ArrowFile", "Seal", "write_arrow"]

Seal = Literal["whole", "header"]
_Read = TypeVar("_Read")

_MAGIC = b"ARROW1"
_HEADER = b"gsvis"
_CHECKSUM = b"checksum"
_HEADER_CHECKSUM = b"gsvis-crc32"
_MARK = b'{"crc32" : "'  # compact JSON cannot contain this text, because of the space
_DIGITS = 8
_TAIL = 10  # length of the footer and magic
_CHUNK = 1 << 24
_BLOCK = np.dtype([("offset", "<i8"), ("metadata", "<i4"), ("padding", "<i4"), ("body", "<i8")])
_FAULTS = (pa.ArrowException, ValueError, OSError, struct.error, MemoryError, OverflowError, StopIteration)
"""Errors that Arrow and this module raise for damaged bytes."""


def write_arrow(
    path: str | os.PathLike[str],
    fields: Iterable[pa.Field],
    header: Mapping[str, Any],
    batches: Iterable[pa.RecordBatch],
    *,
    seal: Seal = "whole",
    sweep: bool = True,
) -> None:
    """Write batches atomically, compressed with zstd.

    Args:
        path: The file.
        fields: Fields of the schema of all batches.
        header: JSON values, among them `format` and `version`.
        batches: The batches; memory holds one at a time.
        seal: Bytes that the checksum covers: the "whole" file, or the "header" alone if each row has its own checksum.
        sweep: Remove the leftovers of killed writers first; see `atomic_path`.
    """
    separators = (",", ":") if seal == "whole" else None
    text = json.dumps(dict(header), separators=separators, sort_keys=True, allow_nan=False).encode()
    mark = {_CHECKSUM: _MARK + b"0" * _DIGITS + b'"}'} if seal == "whole" else {_HEADER_CHECKSUM: _crc_text(text)}
    schema = pa.schema(list(fields), metadata={_HEADER: text, **mark})
    options = pa.ipc.IpcWriteOptions(compression="zstd", use_threads=False)
    with atomic_path(path, sweep=sweep) as partial:
        with pa.OSFile(_name_of(partial), "wb") as sink, pa.ipc.new_file(sink, schema, options=options) as writer:
            for batch in batches:
                writer.write_batch(batch.replace_schema_metadata(schema.metadata))
        if seal == "whole":
            _seal_whole(partial)


class ArrowFile:
    """An open file of one format. Its header, schema and seal are checked when it is opened.

    Args:
        path: The file.
        name: Expected format in the header.
        version: The newest supported version.
        seal: The kind of seal that the file was written with.

    Attributes:
        path: The file.
        header: The JSON header.
        schema: Schema of its batches, without metadata.
        nbytes: Size of the file.

    Raises:
        FormatError: If it is another kind of file, of a newer version, cut or damaged.
        OSError: If it cannot be opened.
    """

    def __init__(self, path: str | os.PathLike[str], name: str, version: int, *, seal: Seal = "whole") -> None:
        self.path = _check.path("path", path)
        self._name = name
        with open_regular(self.path) as file:
            head = file.read(len(_MAGIC))
            self.nbytes = os.fstat(file.fileno()).st_size
        if head != _MAGIC or self.nbytes < 16 + _TAIL:
            got = f"{self.nbytes} bytes" if _MAGIC.startswith(head) else f"a file that begins {head!r}"
            raise FormatError(self.path, "byte 0", f"an Arrow file of format {name}", got)
        with pa.memory_map(_name_of(self.path)) as source:
            self._buffer: pa.Buffer | None = source.read_buffer()  # stays valid after its source is closed
        self.nbytes = self._buffer.size
        data = memoryview(self._buffer)
        if data[-len(_MAGIC) :] != _MAGIC:
            got = repr(bytes(data[-len(_MAGIC) :]))
            raise FormatError(self.path, "", f"{_MAGIC.decode()} at the end", got, f"it was cut; {DAMAGED}")
        self.header, self.schema = self._read_header(_schema_end(self.path, data), version, seal)
        if seal == "whole":
            places = _checksum_places(self.path, data)
            if {bytes(data[place : place + _DIGITS]) for place in places} != {b"%08x" % _checksum(data, places)}:
                raise FormatError(self.path, "", "bytes that fit their checksum", "other bytes", DAMAGED)

    def close(self) -> None:
        """Close the file; no batch can be read afterward."""
        self._buffer = None

    @property
    def closed(self) -> bool:
        """Whether the file was closed."""
        return self._buffer is None

    @property
    def num_batches(self) -> int:
        """Number of batches that the file lists.

        Raises:
            FormatError: If the list is damaged.
        """
        return len(self._blocks)

    def check_schema(self, expected: pa.Schema) -> None:
        """Raise unless the columns are as expected.

        Raises:
            FormatError: If the columns differ; the error names the first one that is missing or has another type.
        """
        if self.schema.equals(expected):
            return
        for field in expected:
            found = self.schema.field(field.name) if self.schema.names.count(field.name) == 1 else None
            if found is None or not found.equals(field):
                raise FormatError(self.path, f"column {field.name!r}", f"{field.type}", f"{found and found.type}")
        raise FormatError(self.path, "columns", ", ".join(expected.names)[:200], ", ".join(self.schema.names)[:200])

    def batches(self, budget: Budget) -> Iterator[pa.RecordBatch]:
        """Yield all batches; see `batch`."""
        for number in range(self.num_batches):
            yield self.batch(number, budget)

    def batch(self, number: int, budget: Budget, where: str = "") -> pa.RecordBatch:
        """Return one batch, validated and without nulls.

        Args:
            number: Number of the batch, from 0.
            budget: Memory budget; the batch claims its size before it is decompressed.
            where: Name of the batch in errors; empty means its number.

        Raises:
            FormatError: If the batch does not fit the schema, holds nulls, or needs more memory than the budget has.
            ValueError: If the file was closed.
        """
        where = where or f"batch {number}"
        message = self._guard(where, "an Arrow message", lambda: self._message(number))
        if message.type != "record batch":
            raise FormatError(self.path, where, "a record batch", f"a {message.type} message", DAMAGED)
        budget.claim(self._guard(where, "a record batch", lambda: _count_uncompressed_bytes(message)), where)

        def read() -> pa.RecordBatch:
            """Return the batch, checked."""
            found = pa.ipc.read_record_batch(message, self.schema)
            found.validate(full=True)
            return found

        batch = self._guard(where, "a valid record batch", read)
        for name, column in zip(batch.schema.names, batch.columns, strict=True):
            if _has_nulls(column):
                raise FormatError(self.path, f"{where}, column {name!r}", "a value in every row", "none in some")
        return batch

    @cached_property
    def _blocks(self) -> NDArray[Any]:
        """Places of the batches in the file, from the footer."""
        data = memoryview(self._open_buffer())
        start = _footer_start(self.path, data)
        end = len(data) - _TAIL
        footer = bytes(data[start:end])
        blocks: NDArray[Any] = self._guard("footer", "a list of batches", lambda: _list_blocks(footer))
        at = blocks["offset"]
        length = blocks["metadata"].astype(np.int64)
        good = (at >= 8) & (at % 8 == 0) & (at <= start) & (length >= 8) & (blocks["body"] >= 0)
        good &= (blocks["body"] <= start) & (at + length + np.minimum(blocks["body"], start) <= start)
        if not good.all():
            first = int(np.argmin(good))
            got = (
                f"{int(length[first]) + int(blocks['body'][first]):,} bytes at byte {int(at[first]):,} of {len(data):,}"
            )
            raise FormatError(self.path, "footer", f"a place of batch {first} within the file", got, DAMAGED)
        return blocks

    def _message(self, number: int) -> pa.Message:
        """Return the message of a batch."""
        offset, length, _, body = self._blocks[number].tolist()
        return pa.ipc.read_message(self._open_buffer().slice(offset, length + body))

    def _open_buffer(self) -> pa.Buffer:
        """Return the buffer; raise if the file is closed."""
        if self._buffer is None:
            raise ValueError("file: expected an open one, got one that was closed; open it again")
        return self._buffer

    def _read_header(self, end: int, version: int, seal: Seal) -> tuple[Fields, pa.Schema]:
        """Return the checked JSON header and the schema."""

        def read() -> pa.Schema:
            """Return the schema, checked."""
            found = pa.ipc.read_schema(self._open_buffer().slice(8, end - 8))
            _ = found.names  # names that are not UTF-8 must raise here, not in an error message
            return found

        schema = self._guard("byte 8", "an Arrow schema", read)
        metadata = schema.metadata or {}
        text = metadata.get(_HEADER)
        if text is None or (seal == "header" and _HEADER_CHECKSUM not in metadata):
            raise FormatError(self.path, "metadata", f"those of format {self._name}", "an Arrow file without them")
        if seal == "header" and metadata[_HEADER_CHECKSUM] != _crc_text(text):
            got = f"{_crc_text(text)!r} for {metadata[_HEADER_CHECKSUM][:16]!r}"
            raise FormatError(self.path, "metadata", "a header that fits its checksum", got, DAMAGED)
        header = parse_object(self.path, text)
        if header.raw("format") != self._name:
            raise FormatError(self.path, "format", self._name, repr(header.raw("format"))[:60])
        found = header.integer("version", 1, 1 << 30)
        if found > version:
            raise FormatError(self.path, "version", f"at most {version}", f"{found}", "update gsvis")
        return header, schema.remove_metadata()

    def _guard(self, where: str, expected: str, read: Callable[[], _Read]) -> _Read:
        """Return `read()`; raise FormatError instead of Arrow's errors for damaged bytes."""
        self._open_buffer()
        try:
            return read()
        except FormatError:
            raise
        except _FAULTS as error:
            got = (str(error).splitlines() or [type(error).__name__])[0]
            raise FormatError(self.path, where, expected, got, DAMAGED) from error


def _seal_whole(path: Path) -> None:
    """Write the checksum of a file over its zeros."""
    with open(path, "r+b") as file, mmap.mmap(file.fileno(), 0) as mapped, memoryview(mapped) as data:
        places = _checksum_places(path, data)
        digits = b"%08x" % _checksum(data, places)
        for place in places:
            data[place : place + _DIGITS] = digits


def _crc_text(data: bytes) -> bytes:
    return b"%08x" % zlib.crc32(data)


def _has_nulls(array: pa.Array) -> bool:
    """Return whether an array or a part of it has nulls."""
    if array.null_count:
        return True
    if pa.types.is_struct(array.type):
        return any(_has_nulls(array.field(k)) for k in range(array.type.num_fields))
    kinds = pa.types.is_list, pa.types.is_large_list, pa.types.is_fixed_size_list
    return any(is_kind(array.type) for is_kind in kinds) and _has_nulls(array.flatten())


def _schema_end(path: Path, data: memoryview) -> int:
    """Return the end of the schema's message, which begins at byte 8."""
    marker, length = struct.unpack_from("<iI", data, 8)
    end = 16 + int(length)
    if marker != -1 or end > len(data) - _TAIL:
        raise FormatError(path, "byte 8", "an Arrow schema", f"a length of {length:,} bytes", DAMAGED)
    return end


def _footer_start(path: Path, data: memoryview) -> int:
    """Return the first byte of the footer."""
    length = int(struct.unpack_from("<I", data, len(data) - _TAIL)[0])
    start = len(data) - _TAIL - length
    if start < 8:
        raise FormatError(path, f"byte {len(data) - _TAIL}", "a footer within the file", f"{length:,} bytes", DAMAGED)
    return start


def _checksum_places(path: Path, data: memoryview) -> list[int]:
    """Return the two offsets of the checksum's digits: in the schema, and in the footer."""
    places = []
    for start, end in ((8, _schema_end(path, data)), (_footer_start(path, data), len(data) - _TAIL)):
        found = bytes(data[start:end]).find(_MARK)
        if found < 0:
            raise FormatError(path, f"bytes {start} to {end}", "a checksum", "none", DAMAGED)
        places.append(start + found + len(_MARK))
    return places


def _checksum(data: memoryview, places: list[int]) -> int:
    """Return the CRC-32 of the file, with zeros in place of the checksum's digits."""
    crc = 0
    start = 0
    for end in [*places, len(data)]:
        for chunk in range(start, end, _CHUNK):
            crc = zlib.crc32(data[chunk : min(chunk + _CHUNK, end)], crc)
        if end < len(data):
            crc = zlib.crc32(b"0" * _DIGITS, crc)
            start = end + _DIGITS
    return crc


def _list_blocks(footer: bytes) -> NDArray[Any]:
    """Return the place of each record batch that a footer lists.

    References:
        Apache Arrow columnar format, "IPC File Format"; FlatBuffers internals, vectors of structs.
    """
    place = _field(footer, _follow_offset(footer, 0), 3)  # Footer.recordBatches
    if not place:
        return np.zeros(0, _BLOCK)
    vector = _follow_offset(footer, place)
    (count,) = struct.unpack_from("<I", footer, vector)
    return np.frombuffer(footer, _BLOCK, count, vector + 4)


def _count_uncompressed_bytes(message: pa.Message) -> int:
    """Return the bytes of memory for the buffers of a record batch, from the first eight bytes of each buffer.

    Raises:
        struct.error: If the message is no record batch; `_FAULTS` lists other possible errors.

    References:
        Apache Arrow columnar format, "Compression" of record batches; FlatBuffers internals, tables and vectors.
    """
    data = message.metadata.to_pybytes()
    batch = _follow_offset(data, _field(data, _follow_offset(data, 0), 2))  # Message.header
    compressed = _field(data, batch, 3) != 0
    buffers = _follow_offset(data, _field(data, batch, 2))
    body = message.body
    total = 0
    for k in range(struct.unpack_from("<I", data, buffers)[0]):
        offset, length = struct.unpack_from("<qq", data, buffers + 4 + 16 * k)
        total += length
        if length and compressed:
            (size,) = struct.unpack_from("<q", body[offset : offset + 8].to_pybytes())
            total += max(size, 0)
    return int(total)


def _field(data: bytes, table: int, slot: int) -> int:
    """Return the place of a slot's field in a FlatBuffers table; 0 if the table has none."""
    vtable = table - struct.unpack_from("<i", data, table)[0]
    if 4 + 2 * slot >= struct.unpack_from("<H", data, vtable)[0]:
        return 0
    offset: int = struct.unpack_from("<H", data, vtable + 4 + 2 * slot)[0]
    return table + offset if offset else 0


def _name_of(path: str | os.PathLike[str]) -> bytes:
    """Return a file name in UTF-8, as Arrow requires; names on disk may have another encoding."""
    return os.fsencode(path)


def _follow_offset(data: bytes, place: int) -> int:
    """Return the place to which an offset of FlatBuffers at `place` points."""
    return place + int(struct.unpack_from("<I", data, place)[0])
