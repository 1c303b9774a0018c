"""Move the arrays of large objects into mapped files, and release their memory while they are not needed."""

from __future__ import annotations

import pickle
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np

from gsvis.files.mapped import MappedArrays, write_arrays

__all__ = ["LARGE", "Shelf", "Shelved", "shelve"]

LARGE = 256 << 20
"""Bytes of a scene from which its arrays lie in a file while a package is prepared."""

_Thing = TypeVar("_Thing")


@dataclass(frozen=True, eq=False)
class Shelved(Generic[_Thing]):
    """An object whose arrays lie in a file. It can be sent to other processes, which then share the arrays' memory.

    Attributes:
        path: The file of the arrays.
        rest: The rest of the object, pickled.
    """

    path: Path
    rest: bytes

    def open(self) -> _Thing:
        """Return the object; its arrays are views of the file, and stay as they were if one is written to.

        Raises:
            FormatError: If the file is damaged.
            OSError: If it is gone.
        """
        return self.over(MappedArrays(self.path))

    def over(self, mapped: MappedArrays) -> _Thing:
        """Return the object over its open file."""
        found: _Thing = pickle.loads(self.rest, buffers=list(mapped.arrays.values()))
        return found


def shelve(thing: _Thing, path: Path) -> Shelved[_Thing]:
    """Write the arrays of an object to a file, which holds nothing else; drop the object to free its memory.

    Arrays that are shared with other objects are copied. Read-only arrays stay read-only.

    Raises:
        OutputError: If the file cannot be written.
    """
    buffers: list[pickle.PickleBuffer] = []
    rest = pickle.dumps(thing, protocol=5, buffer_callback=buffers.append)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_arrays(path, {str(k): np.asarray(buffer.raw()) for k, buffer in enumerate(buffers)}, {})
    return Shelved(path, rest)


class Shelf:
    """Objects whose arrays lie in files. They work as before; a page is in memory from its first use to `release`.

    The files hold arrays alone. The rest of the objects stays in memory, so nothing is unpickled from a file.

    Args:
        folder: Folder for the files; it may not exist yet. The caller removes it after the last use of the objects.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._files: list[MappedArrays] = []

    def put(self, thing: _Thing) -> _Thing:
        """Return an object with its arrays in a file; see `shelve`. Drop the one that was given."""
        shelved = shelve(thing, self._folder / f"{len(self._files)}.arrays")
        mapped = MappedArrays(shelved.path)
        self._files.append(mapped)
        return shelved.over(mapped)

    def release(self) -> None:
        """Release the memory of all arrays; the next use reads them from their files again."""
        for file in self._files:
            file.release()
