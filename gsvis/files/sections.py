"""Read and write files of named sections after a head of 40 bytes, with checksums over all bytes, memory-mapped.

This is the second container beside `gsvis.files.arrow`. It is for data that is packed already and read in small pieces,
each with its own checksum. docs/design/006-visibility-store.md explains why it is no Arrow file.

The file holds the head, then the sections, then a JSON header that lists them. The head holds the length of the file,
so a cut file is found before anything is read. This module does not know the content of sections.
"""

from __future__ import annotations

import json
import mmap
import os
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, BinaryIO

from gsvis import _check
from gsvis.errors import FormatError
from gsvis.files.fields import Fields, parse_object
from gsvis.files.joined import JoinedFiles
from gsvis.files.limits import DAMAGED, open_regular

__all__ = ["HEAD_BYTES", "FileKind", "Section", "SectionFile", "SectionWriter"]

_HEAD = struct.Struct("<8sIIQQII")
HEAD_BYTES = _HEAD.size


@dataclass(frozen=True)
class FileKind:
    """A kind of file of sections.

    Attributes:
        magic: First 8 bytes. Begin with a byte that no text file has, and end with a line break, which a text-mode
            transfer changes.
        version: The only supported version of the container.
        name: Name of the kind, such as "a store of visible sets".
        remedy: Remedy for a file of another kind.
    """

    magic: bytes
    version: int
    name: str
    remedy: str


@dataclass(frozen=True)
class Section:
    """The place of a section: first byte, length, and CRC-32."""

    offset: int
    length: int
    crc: int


class SectionWriter:
    """Writes sections one after the other to an open file.

    Args:
        file: The file, empty.
        kind: Kind of the file.
    """

    def __init__(self, file: BinaryIO, kind: FileKind) -> None:
        self._file = file
        self._kind = kind
        self._sections: dict[str, Section] = {}
        self._start = self._end = HEAD_BYTES
        self._crc = 0
        file.write(bytes(HEAD_BYTES))

    @property
    def size(self) -> int:
        """Bytes written so far."""
        return self._end

    def append(self, data: bytes) -> tuple[int, int, int]:
        """Add bytes to the open section; return their offset in the section, their length and their CRC-32."""
        offset = self._end - self._start
        self._file.write(data)
        self._crc = zlib.crc32(data, self._crc)
        self._end += len(data)
        return offset, len(data), zlib.crc32(data)

    def close_section(self, name: str) -> None:
        """Close the section that holds everything appended since the last call, and name it."""
        self._sections[name] = Section(self._start, self._end - self._start, self._crc)
        self._start = self._end
        self._crc = 0

    def finish(self, header: Mapping[str, Any]) -> None:
        """Write the header with the list of sections, then the head."""
        listed = [[name, s.offset, s.length, s.crc] for name, s in self._sections.items()]
        text = json.dumps({**header, "sections": listed}, separators=(",", ":"), sort_keys=True, allow_nan=False)
        data = text.encode()
        self._file.write(data)
        fields = (self._end + len(data), self._end, len(data), zlib.crc32(data))
        crc = zlib.crc32(struct.pack("<QQII", *fields))
        self._file.seek(0)
        self._file.write(_HEAD.pack(self._kind.magic, self._kind.version, crc, *fields))


class SectionFile:
    """An open file of sections.

    Args:
        path: The file.
        kind: Expected kind of the file.
        joined: The content of the file, if it lies in several; `path` only names it then. None maps the file.

    Raises:
        FormatError: If the head, the length, the header or the list of sections is not valid.
        OSError: If the file cannot be opened.
    """

    def __init__(self, path: str | os.PathLike[str], kind: FileKind, joined: JoinedFiles | None = None) -> None:
        self.path = _check.path("path", path)
        self.kind = kind
        self._joined = joined
        self._map: mmap.mmap | None = None
        if joined is not None:
            size = joined.size
            place, length, crc = self._read_head(joined.read(0, HEAD_BYTES), size)
        else:
            with open_regular(self.path) as file:
                size = os.fstat(file.fileno()).st_size
                place, length, crc = self._read_head(file.read(HEAD_BYTES), size)
                self._map = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        try:
            self.size = size
            self.header = self._read_header(place, length, crc)
            self.sections = self._read_list(place)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the file."""
        if self._joined is not None:
            self._joined.close()
        self._joined = None
        if self._map is not None:
            self._map.close()

    def _bytes(self, start: int, length: int) -> bytes:
        """Return bytes from a place on."""
        if self._joined is not None:
            return self._joined.read(start, length)
        if self._map is None or self._map.closed:
            raise ValueError("file: expected an open one, got one that was closed; open it again")
        return self._map[start : start + length]

    def _read_head(self, head: bytes, size: int) -> tuple[int, int, int]:
        """Return the place, the length and the CRC-32 of the header."""
        known = self.kind.magic
        if len(head) < HEAD_BYTES:
            if not known.startswith(head[: len(known)]) and not head.startswith(known):
                raise self._foreign(head)
            raise FormatError(self.path, "byte 0", f"a head of {HEAD_BYTES} bytes", f"{len(head)} bytes", DAMAGED)
        magic, version, crc, total, place, length, header_crc = _HEAD.unpack(head)
        if magic != known:
            raise self._foreign(head)
        if version != self.kind.version:
            remedy = "update gsvis, or make it again" if version > self.kind.version else "make it again"
            raise FormatError(self.path, "byte 8", f"version {self.kind.version}", f"version {version}", remedy)
        if (found := zlib.crc32(head[16:])) != crc:
            raise FormatError(self.path, "byte 16", f"a head with checksum {crc:08x}", f"{found:08x}", DAMAGED)
        if size != total:
            raise FormatError(self.path, "byte 16", f"a file of {total} bytes", f"{size} bytes", DAMAGED)
        if not (HEAD_BYTES <= place <= total and place + length == total):
            raise FormatError(self.path, "byte 24", "a header at the end of the file", f"one at byte {place}", DAMAGED)
        return place, length, header_crc

    def _foreign(self, head: bytes) -> FormatError:
        """Return the error for a file of a different format."""
        got = f"a file that begins {head[:8]!r}"
        return FormatError(self.path, "byte 0", self.kind.name, got, self.kind.remedy)

    def _read_header(self, place: int, length: int, crc: int) -> Fields:
        """Return the header."""
        data = self._bytes(place, length)
        if (found := zlib.crc32(data)) != crc:
            raise FormatError(self.path, f"byte {place}", f"a header with checksum {crc:08x}", f"{found:08x}", DAMAGED)
        return parse_object(self.path, data)

    def _read_list(self, end: int) -> dict[str, Section]:
        """Return the sections by name."""
        sections = {}
        place = HEAD_BYTES
        for row in self.header.items("sections"):
            good = isinstance(row, list) and len(row) == 4 and isinstance(row[0], str)
            if not good or not all(isinstance(v, int) and 0 <= v < 1 << 62 for v in row[1:]) or row[1] != place:
                raise FormatError(self.path, "sections", "name, offset, length and checksum of each", repr(row)[:60])
            sections[row[0]] = Section(*row[1:])
            place += row[2]
        if place != end:
            raise FormatError(self.path, "sections", f"sections that end at byte {end}", f"an end at byte {place}")
        return sections

    def section(self, name: str) -> Section:
        """Return the place of a section; raise FormatError if it is missing."""
        if name not in self.sections:
            raise FormatError(self.path, "sections", f"a section {name!r}", "none", DAMAGED)
        return self.sections[name]

    def read(self, name: str) -> bytes:
        """Return the bytes of a section, checked against its CRC-32."""
        s = self.section(name)
        data = self._bytes(s.offset, s.length)
        if zlib.crc32(data) != s.crc:
            raise self.damaged(f"section {name!r}, byte {s.offset}")
        return data

    def read_part(self, name: str, offset: int, length: int, crc: int, where: str) -> bytes:
        """Return a part of a section, checked against the part's CRC-32 `crc`."""
        s = self.section(name)
        if min(offset, length) < 0 or offset + length > s.length:
            raise FormatError(self.path, where, f"a place inside section {name!r}", f"byte {offset}", DAMAGED)
        start = s.offset + offset
        data = self._bytes(start, length)
        if zlib.crc32(data) != crc:
            raise self.damaged(f"{where}, byte {start}")
        return data

    def damaged(self, where: str) -> FormatError:
        """Return the error for bytes that do not match their checksum."""
        return FormatError(self.path, where, "bytes that fit their checksum", "other bytes", DAMAGED)
