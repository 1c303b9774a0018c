"""Arrow IPC files that any Arrow client reads, with a mark of ours, every byte under a checksum, and bounded memory.

The schema's metadata hold a JSON header under `gsvis`, and under `checksum` the CRC-32 of the file with the digits of
the checksum itself taken as zeros. Nothing but the schema is parsed before it fits. This module knows no columns.
"""

from __future__ import annotations

import json
import mmap
import os
import struct
import zlib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa

from gsvis import _check
from gsvis.errors import FormatError
from gsvis.files.atomic import atomic_path
from gsvis.files.fields import Fields, parse_object
from gsvis.files.limits import Budget, open_regular

__all__ = ["FAULTS", "ArrowFile", "count_uncompressed_bytes", "write_arrow"]

_MAGIC = b"ARROW1"
_HEADER, _CHECKSUM = b"gsvis", b"checksum"
_MARK = b'{"crc32" : "'  # the space sets it apart from every value that compact JSON can hold
_DIGITS = 8
_TAIL = 10  # length of the footer and magic
_CHUNK = 1 << 24
_AGAIN = "the file is damaged: copy or write it again"
FAULTS = (pa.ArrowException, ValueError, OSError, struct.error, MemoryError, OverflowError)
"""What Arrow and the code here raise at damaged bytes."""


def write_arrow(
    path: str | os.PathLike[str],
    fields: Iterable[pa.Field],
    header: Mapping[str, Any],
    batches: Iterable[pa.RecordBatch],
) -> None:
    """Write batches as they come, compressed with zstd, whole or not at all.

    Args:
        path: The file.
        fields: Of the schema that all batches have.
        header: What JSON can say; holds `format` and `version`.
        batches: Kept in memory one at a time.
    """
    text = json.dumps(dict(header), separators=(",", ":"), sort_keys=True, allow_nan=False).encode()
    schema = pa.schema(fields, metadata={_HEADER: text, _CHECKSUM: _MARK + b"0" * _DIGITS + b'"}'})
    options = pa.ipc.IpcWriteOptions(compression="zstd", use_threads=False)
    with atomic_path(path) as partial:
        with pa.OSFile(os.fspath(partial), "wb") as sink, pa.ipc.new_file(sink, schema, options=options) as writer:
            for batch in batches:
                writer.write_batch(batch.replace_schema_metadata(schema.metadata))
        with open(partial, "r+b") as file, mmap.mmap(file.fileno(), 0) as mapped, memoryview(mapped) as data:
            places = _places(partial, data)
            digits = b"%08x" % _checksum(data, places)
            for place in places:
                data[place : place + _DIGITS] = digits


class ArrowFile:
    """An open file of one format, its header and its schema checked and its checksum found to fit.

    Args:
        path: The file.
        name: The format that its header must name.
        version: The newest version that is known.

    Attributes:
        header: The JSON header.
        schema: Of its batches, without metadata.

    Raises:
        FormatError: If it is another kind of file, of a newer version, cut or damaged.
        OSError: If it cannot be opened.
    """

    def __init__(self, path: str | os.PathLike[str], name: str, version: int) -> None:
        self.path, self._name = _check.path("path", path), name
        with open_regular(self.path) as file:
            head, self._size = file.read(len(_MAGIC)), os.fstat(file.fileno()).st_size
        if head != _MAGIC or self._size < 16 + _TAIL:
            got = f"{self._size} bytes" if _MAGIC.startswith(head) else f"a file that begins {head!r}"
            raise FormatError(self.path, "byte 0", f"an Arrow file of format {name}", got)
        with pa.memory_map(os.fspath(self.path)) as source:
            self._buffer = source.read_buffer()  # lives on without its source
        self._size = self._buffer.size
        data = memoryview(self._buffer)
        if data[-len(_MAGIC) :] != _MAGIC:
            raise FormatError(self.path, "", f"{_MAGIC.decode()} at the end", "another end", f"it was cut; {_AGAIN}")
        self.header, self.schema = self._read_header(_schema_end(self.path, data), version)
        places = _places(self.path, data)
        if {bytes(data[place : place + _DIGITS]) for place in places} != {b"%08x" % _checksum(data, places)}:
            raise FormatError(self.path, "", "bytes that fit their checksum", "other bytes", _AGAIN)

    @property
    def nbytes(self) -> int:
        """Size of the file."""
        return self._size

    def batches(self, budget: Budget) -> Iterator[pa.RecordBatch]:
        """All batches, validated and without nulls; each claims what it will need before it is decompressed.

        Raises:
            FormatError: If a batch does not fit the schema, holds nulls, or needs more memory than the budget has.
        """
        for where, message in self._messages():
            try:
                promised = count_uncompressed_bytes(message)
            except FAULTS as error:
                raise FormatError(self.path, where, "a record batch", str(error), _AGAIN) from error
            budget.claim(promised, where)
            try:
                batch = pa.ipc.read_record_batch(message, self.schema)
                batch.validate(full=True)
            except FAULTS as error:
                raise FormatError(self.path, where, "a valid record batch", str(error), _AGAIN) from error
            for name, column in zip(batch.schema.names, batch.columns, strict=True):
                if _has_nulls(column):
                    raise FormatError(self.path, f"{where}, column {name!r}", "a value in every row", "none in some")
            yield batch

    def _messages(self) -> Iterator[tuple[str, pa.Message]]:
        """All messages after the schema, and their names."""
        number = -1
        reader = pa.ipc.MessageReader.open_stream(self._buffer.slice(8))
        while True:
            where = f"batch {number}"
            try:
                message = reader.read_next_message()
            except StopIteration:
                return
            except FAULTS as error:
                raise FormatError(self.path, where, "an Arrow message", str(error), _AGAIN) from error
            if number >= 0:
                if message.type != "record batch":
                    raise FormatError(self.path, where, "a record batch", f"a {message.type} message", _AGAIN)
                yield where, message
            number += 1

    def _read_header(self, end: int, version: int) -> tuple[Fields, pa.Schema]:
        try:
            schema = pa.ipc.read_schema(self._buffer.slice(8, end - 8))
            _ = schema.names  # those that are not UTF-8 raise here, not where an error lists them
        except FAULTS as error:
            raise FormatError(self.path, "byte 8", "an Arrow schema", str(error), _AGAIN) from error
        text = (schema.metadata or {}).get(_HEADER)
        if text is None:
            raise FormatError(self.path, "metadata", f"those of format {self._name}", "an Arrow file without them")
        header = parse_object(self.path, text)
        if header.raw("format") != self._name:
            raise FormatError(self.path, "format", self._name, repr(header.raw("format"))[:60])
        found = header.integer("version", 1, 1 << 30)
        if found > version:
            raise FormatError(self.path, "version", f"at most {version}", f"{found}", "update gsvis")
        return header, schema.remove_metadata()


def _has_nulls(array: pa.Array) -> bool:
    if array.null_count:
        return True
    if pa.types.is_struct(array.type):
        return any(_has_nulls(array.field(k)) for k in range(array.type.num_fields))
    kinds = pa.types.is_list, pa.types.is_large_list, pa.types.is_fixed_size_list
    return any(is_kind(array.type) for is_kind in kinds) and _has_nulls(array.flatten())


def _schema_end(path: Path, data: memoryview) -> int:
    """Where the schema's message, which begins at byte 8, ends."""
    marker, length = struct.unpack_from("<iI", data, 8)
    end = 16 + int(length)
    if marker != -1 or end > len(data) - _TAIL:
        raise FormatError(path, "byte 8", "an Arrow schema", f"a length of {length:,} bytes", _AGAIN)
    return end


def _footer_start(path: Path, data: memoryview) -> int:
    length = int(struct.unpack_from("<I", data, len(data) - _TAIL)[0])
    start = len(data) - _TAIL - length
    if start < 8:
        raise FormatError(path, f"byte {len(data) - _TAIL}", "a footer within the file", f"{length:,} bytes", _AGAIN)
    return start


def _places(path: Path, data: memoryview) -> list[int]:
    """Where the digits of the checksum stand: in the schema and, a second time, in the footer."""
    places = []
    for start, end in ((8, _schema_end(path, data)), (_footer_start(path, data), len(data) - _TAIL)):
        found = bytes(data[start:end]).find(_MARK)
        if found < 0:
            raise FormatError(path, f"bytes {start} to {end}", "a checksum", "none", _AGAIN)
        places.append(start + found + len(_MARK))
    return places


def _checksum(data: memoryview, places: list[int]) -> int:
    """CRC-32 of everything, zeros in place of the checksum's digits."""
    crc, start = 0, 0
    for end in [*places, len(data)]:
        for chunk in range(start, end, _CHUNK):
            crc = zlib.crc32(data[chunk : min(chunk + _CHUNK, end)], crc)
        if end < len(data):
            crc = zlib.crc32(b"0" * _DIGITS, crc)
            start = end + _DIGITS
    return crc


def count_uncompressed_bytes(message: pa.Message) -> int:
    """Return what the buffers of a record batch need in memory, as the first eight bytes of each say.

    Raises:
        struct.error: If the message is no record batch; `FAULTS` names what else may be raised.

    References:
        Apache Arrow columnar format, "Compression" of record batches; FlatBuffers internals, tables and vectors.
    """
    data = message.metadata.to_pybytes()

    def field(table: int, slot: int) -> int:
        vtable = table - struct.unpack_from("<i", data, table)[0]
        if 4 + 2 * slot >= struct.unpack_from("<H", data, vtable)[0]:
            return 0
        offset: int = struct.unpack_from("<H", data, vtable + 4 + 2 * slot)[0]
        return table + offset if offset else 0

    def follow(place: int) -> int:
        return place + int(struct.unpack_from("<I", data, place)[0])

    batch = follow(field(follow(0), 2))  # Message.header
    compressed = field(batch, 3) != 0
    buffers = follow(field(batch, 2))
    body, total = message.body, 0
    for k in range(struct.unpack_from("<I", data, buffers)[0]):
        offset, length = struct.unpack_from("<qq", data, buffers + 4 + 16 * k)
        total += length
        if length and compressed:
            (size,) = struct.unpack_from("<q", body[offset : offset + 8].to_pybytes())
            total += max(size, 0)
    return int(total)
