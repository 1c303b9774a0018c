"""A file of named arrays that are memory-mapped: opening it reads a few kilobytes, and pages are read when touched.

Such a file is a cache of what can be computed again. Its head is under a checksum; its arrays are not, because checking
them would read them. So keep it in a folder that only its owner can write to. Processes that map the same file share
its memory.
"""

from __future__ import annotations

import json
import mmap
import os
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.errors import FormatError
from gsvis.files.atomic import atomic_path
from gsvis.files.limits import DAMAGED, open_regular
from gsvis.files.resume import seal, unseal

__all__ = ["MappedArrays", "resident_bytes", "write_arrays"]

_MAGIC = b"\x93gsvisM\n"
_HEAD = struct.Struct("<8sQ")  # magic, bytes of the sealed JSON after it
_PAGE = 1 << 12
_MOST_HEAD = 64 << 20


def write_arrays(path: str | os.PathLike[str], arrays: Mapping[str, NDArray[Any]], facts: Mapping[str, Any]) -> None:
    """Write arrays and facts as a file for `MappedArrays`, atomically.

    Args:
        path: The file.
        arrays: Contiguous arrays by name; whether each may be written to is kept. Names of the same array share bytes.
        facts: JSON values.

    Raises:
        OutputError: If the file cannot be written.
    """
    rows, blocks, places, end = [], [], dict[int, int](), 0
    for name, array in arrays.items():
        whole = np.ascontiguousarray(array)
        place = places.get(id(array))
        if place is None:
            place = places[id(array)] = end
            blocks.append(whole)
            end += -(-whole.nbytes // _PAGE) * _PAGE
        rows.append([name, whole.dtype.str, list(array.shape), place, bool(array.flags.writeable)])
    head = seal(json.dumps({"facts": facts, "arrays": rows, "bytes": end}, allow_nan=False).encode())
    with atomic_path(path) as partial, partial.open("r+b") as file:
        file.write(_HEAD.pack(_MAGIC, len(head)) + head)
        file.write(bytes(-file.tell() % _PAGE))
        for block in blocks:
            file.write(block.reshape(-1).view(np.uint8).data)
            file.write(bytes(-file.tell() % _PAGE))


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
            self.nbytes, self.facts = int(said["bytes"]), said["facts"]
            if size != start + self.nbytes:
                raise FormatError(self.path, "", f"{start + self.nbytes:,} bytes", f"{size:,}", DAMAGED)
            self._map = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY)
        self._start = start
        self.arrays = {row[0]: self._view(*row[1:]) for row in said["arrays"]}

    def _view(self, kind: str, shape: list[int], place: int, writable: bool) -> NDArray[Any]:
        found = np.frombuffer(self._map, np.dtype(kind), int(np.prod(shape)), self._start + place).reshape(shape)
        found.flags.writeable = writable
        return found

    def release(self) -> None:
        """Give back the memory of all pages; a page that is touched again comes from the file.

        Safe at any time, also while other threads read: the content stays the same. Does nothing where the system has
        no such call.
        """
        if hasattr(self._map, "madvise"):
            self._map.madvise(mmap.MADV_DONTNEED)


def resident_bytes() -> int:
    """Return the bytes of files that this process has in memory, shared ones too; 0 where the system does not say."""
    try:
        return int(Path("/proc/self/statm").read_bytes().split()[2]) * mmap.PAGESIZE
    except (OSError, IndexError, ValueError):
        return 0


def _read_head(path: Path, head: bytes, read: Any) -> tuple[int, dict[str, Any]]:
    """Return where the arrays begin, and the content of the head."""
    magic, length = _HEAD.unpack(head) if len(head) == _HEAD.size else (b"", 0)
    sealed = read(length) if magic == _MAGIC and length <= _MOST_HEAD else b""
    data = unseal(sealed)
    if data is None:
        raise FormatError(path, "byte 0", "a file of arrays", "another file", "remove it; it is made again")
    return -(-(_HEAD.size + length) // _PAGE) * _PAGE, json.loads(data)
