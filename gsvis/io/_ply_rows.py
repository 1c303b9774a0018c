"""Read the rows of one element of a PLY file, binary or text, in chunks that fit into the cache.

Knows the layout of rows, not the meaning of a property.
"""

from __future__ import annotations

from collections.abc import Iterator
from io import BufferedReader
from itertools import islice
from typing import Any, BinaryIO, cast

import numpy as np
from numpy.typing import NDArray

from gsvis.errors import FormatError
from gsvis.io._ply_header import Element, PlyHeader

__all__ = ["CHUNK_BYTES", "read_rows", "row_chunks"]

CHUNK_BYTES = 2 << 20
"""Bytes that are read, transposed and activated at a time, so that they fit into the cache."""


def row_chunks(header: PlyHeader, element: Element, stream: BinaryIO) -> Iterator[NDArray[Any]]:
    """Yield the rows of an element, a few thousand at a time; each chunk overwrites the previous one.

    Args:
        header: Header of the file.
        element: One of its elements.
        stream: The file, opened for bytes.

    Yields:
        Structured rows in the file's byte order, one field for each property.

    Raises:
        FormatError: If the rows do not fit into the file, or are not numbers.
    """
    row, offset = header.rows_of(element)
    per_chunk = max(1, CHUNK_BYTES // row.itemsize)
    if header.encoding == "ascii":
        yield from _ascii_chunks(header, element, stream, row, per_chunk)
        return
    stream.seek(offset)
    buffer = np.empty(min(per_chunk, element.count), row)
    raw = buffer.view(np.uint8).data
    for start in range(0, element.count, per_chunk):
        rows = min(per_chunk, element.count - start)
        if cast(BufferedReader, stream).readinto(raw[: rows * row.itemsize]) != rows * row.itemsize:
            raise FormatError(header.path, f"row {start:,}", "a file that does not change while it is read", "its end")
        yield buffer[:rows]


def read_rows(header: PlyHeader, element: Element, stream: BinaryIO, rows: NDArray[np.int64]) -> NDArray[Any]:
    """Return some rows of an element, in the order of `rows`; reads the whole of a text file.

    Raises:
        FormatError: As `row_chunks`.
    """
    row, offset = header.rows_of(element)
    found = np.empty(len(rows), row)
    if header.encoding == "ascii":
        start = 0
        for chunk in row_chunks(header, element, stream):
            inside = (rows >= start) & (rows < start + len(chunk))
            found[inside] = chunk[rows[inside] - start]
            start += len(chunk)
        return found
    for k, number in enumerate(rows.tolist()):
        stream.seek(offset + number * row.itemsize)
        data = stream.read(row.itemsize)
        if len(data) != row.itemsize:
            raise FormatError(header.path, f"row {number:,}", "a file that does not change while it is read", "its end")
        found[k] = np.frombuffer(data, row)[0]
    return found


def _ascii_chunks(
    header: PlyHeader, element: Element, stream: BinaryIO, row: np.dtype[np.void], per_chunk: int
) -> Iterator[NDArray[Any]]:
    """Yield the rows of a text file; see `row_chunks`."""
    stream.seek(header.size)
    lines = islice(stream, element.offset, None)
    for start in range(0, element.count, per_chunk):
        rows = min(per_chunk, element.count - start)
        words = b" ".join(islice(lines, rows)).split()
        where = f"element {element.name}, rows {start:,} to {start + rows - 1:,}"
        if len(words) != rows * len(element.properties):
            raise FormatError(
                header.path, where, f"{rows * len(element.properties):,} numbers", f"{len(words):,}", "is it truncated?"
            )
        try:
            values = np.array(words, dtype=np.float64).reshape(rows, -1)
        except ValueError as error:
            raise FormatError(header.path, where, "numbers", str(error)) from error
        table = np.empty(rows, row)
        with np.errstate(all="ignore"):
            for j, name in enumerate(element.properties):
                table[name] = values[:, j]
        yield table
