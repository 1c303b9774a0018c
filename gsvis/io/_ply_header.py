"""Parse the header of a PLY file: its elements, their properties and where their rows begin.

Knows only the syntax, not the meaning of a property. Reads scalar properties of every PLY type in all three encodings.
Elements with list properties are allowed only after the elements that are read.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from typing import BinaryIO

import numpy as np

from gsvis.errors import FormatError

__all__ = ["Element", "PlyHeader", "parse_header"]

_TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "float32": "f4",
    "float64": "f8",
}
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}
_MAX_HEADER = 1 << 20
_MOST_COMMENTS = 256


@dataclass(frozen=True)
class Element:
    """One element: `count` rows of scalar properties.

    Args:
        name: Name, such as `vertex`.
        count: Number of rows.
        row: Packed row type with one field for each property; None if a property is a list.
        offset: First byte of its rows in a binary file; for ascii the number of rows before it; None if an element
            with lists precedes it.
    """

    name: str
    count: int
    row: np.dtype[np.void] | None
    offset: int | None

    @property
    def properties(self) -> tuple[str, ...]:
        """Names of the scalar properties, in file order."""
        return self.row.names or () if self.row is not None else ()


@dataclass(frozen=True)
class PlyHeader:
    """Contents of the header of a PLY file.

    Args:
        path: The file.
        encoding: One of binary_little_endian, binary_big_endian, ascii.
        elements: The elements, in file order.
        size: Bytes of the header.
        file_size: Bytes of the file.
        comments: Text of its comments, in file order, the first ones if there are many.
    """

    path: str
    encoding: str
    elements: tuple[Element, ...]
    size: int
    file_size: int
    comments: tuple[str, ...] = ()

    def element(self, name: str) -> Element | None:
        """Return the element with that name, or None."""
        return next((e for e in self.elements if e.name == name), None)

    def rows_of(self, element: Element) -> tuple[np.dtype[np.void], int]:
        """Return the row type and offset of an element, after checking that its rows fit into the file.

        Raises:
            FormatError: If the element has lists or follows lists, or the file is too short for its rows.
        """
        if element.row is None or element.offset is None:
            raise FormatError(
                self.path,
                f"element {element.name}",
                "scalar properties, with no list element before them",
                "a list property",
                "write the Gaussians as the first element",
            )
        if self.encoding == "ascii":
            left = self.file_size - self.size
            needed = 2 * element.count * len(element.properties) - 1
        else:
            left = self.file_size - element.offset
            needed = element.count * element.row.itemsize
        if needed > left:
            raise FormatError(
                self.path,
                f"byte {self.file_size:,}",
                f"{needed:,} bytes for the {element.count:,} rows of element {element.name}",
                f"{max(0, left):,} bytes to the end of the file",
                "the file is truncated or its header is wrong",
            )
        return element.row, element.offset


def parse_header(path: str | os.PathLike[str], stream: BinaryIO, file_size: int) -> PlyHeader:
    """Read a PLY header from the start of a stream.

    Args:
        path: The file, for error messages.
        stream: Opened for bytes, at its start; left after the header.
        file_size: Bytes of the file.

    Raises:
        FormatError: If this is not a PLY header.
    """
    path = os.fspath(path)
    first = stream.readline(16)
    if first.rstrip(b"\r\n") != b"ply":
        raise FormatError(path, "byte 0", "the magic line 'ply'", repr(first[:8])[1:])
    encoding = ""
    elements: dict[str, _Parsed] = {}
    current: _Parsed | None = None
    comments: list[str] = []
    while True:
        at = stream.tell()
        line = stream.readline(4096)
        if not line.endswith(b"\n") or at > _MAX_HEADER:
            raise FormatError(path, f"byte {at:,}", "an end_header line", "none", "the file is truncated or not a PLY")
        words = line.decode("ascii", "replace").split()
        where = f"byte {at:,}"
        if words == ["end_header"]:
            break
        if not words or words[0] in ("comment", "obj_info"):
            if words and len(comments) < _MOST_COMMENTS:
                comments.append(" ".join(words[1:]))
            continue
        if words[0] == "format" and len(words) == 3 and words[1] in _ORDERS and not elements:
            encoding = words[1]
        elif words[0] == "element" and len(words) == 3 and words[2].isdecimal() and len(words[2]) <= 18 and encoding:
            if words[1] in elements:
                raise FormatError(path, where, "one element of each name", f"a second element {words[1]}")
            current = elements[words[1]] = _Parsed(int(words[2]))
        elif words[0] == "property" and len(words) == 3 and words[1] in _TYPES and current:
            if words[2] in current.fields:
                raise FormatError(path, where, "one property of each name", f"a second property {words[2]}")
            current.fields[words[2]] = _ORDERS[encoding] + _TYPES[words[1]]
        elif words[0] == "property" and len(words) == 5 and words[1] == "list" and current:
            current.lists = True
        else:
            raise FormatError(path, where, "a PLY header line", repr(line[:60].rstrip())[1:])
    placed = _place(elements, encoding, stream.tell())
    return PlyHeader(path, encoding, placed, stream.tell(), file_size, tuple(comments))


@dataclass
class _Parsed:
    """An element during parsing: property names with their numpy types."""

    count: int
    fields: dict[str, str] = field(default_factory=dict)
    lists: bool = False


def _place(parsed: dict[str, _Parsed], encoding: str, header_size: int) -> tuple[Element, ...]:
    """Return the elements with their row types and offsets."""
    placed = []
    offset: int | None = 0 if encoding == "ascii" else header_size
    for name, element in parsed.items():
        fields = list(element.fields.items())
        if encoding == "ascii":  # text is read as float64, whatever type is declared
            fields = [(each, "=f8" if kind == "=f4" else kind) for each, kind in fields]
        row = None if element.lists else np.dtype(fields)
        placed.append(Element(name, element.count, row, offset))
        if row is None:
            offset = offset if element.count == 0 else None
        elif offset is not None:
            offset += element.count if encoding == "ascii" else element.count * row.itemsize
    return tuple(placed)
