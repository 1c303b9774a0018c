"""Move the arrays of large objects into mapped files, and release their memory while they are not needed."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import TypeVar

import numpy as np

from gsvis.files.mapped import MappedArrays, write_arrays

__all__ = ["Shelf"]

_Thing = TypeVar("_Thing")


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
        """Return an object with its arrays in a file; drop the original to free its memory.

        Arrays that are shared with other objects are copied. Read-only arrays stay read-only.

        Raises:
            OutputError: If the file cannot be written.
        """
        buffers: list[pickle.PickleBuffer] = []
        rest = pickle.dumps(thing, protocol=5, buffer_callback=buffers.append)
        self._folder.mkdir(parents=True, exist_ok=True)
        path = self._folder / f"{len(self._files)}.arrays"
        write_arrays(path, {str(k): np.asarray(buffer.raw()) for k, buffer in enumerate(buffers)}, {})
        mapped = MappedArrays(path)
        self._files.append(mapped)
        found: _Thing = pickle.loads(rest, buffers=list(mapped.arrays.values()))
        return found

    def release(self) -> None:
        """Release the memory of all arrays; the next use reads them from their files again."""
        for file in self._files:
            file.release()
