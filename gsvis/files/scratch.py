"""Arrays that change and may lie in temporary files, so that their memory can be given back while they are in use.

A page that was given back comes from its file when it is touched again. So work that goes through a part of large
arrays at a time holds little more than that part.
"""

from __future__ import annotations

import mmap
import os
import tempfile
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from gsvis.files.mapped import give_back
from gsvis.files.output import output_errors

__all__ = ["Scratch"]


class Scratch:
    """Makes arrays to write to. The files have no name and vanish with the last use of the arrays.

    Args:
        folder: Folder for the files; None keeps the arrays in memory.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self._folder = folder
        self._maps: list[mmap.mmap] = []

    def zeros(self, shape: tuple[int, ...], dtype: DTypeLike = np.float32) -> NDArray[Any]:
        """Return an array of zeros.

        Raises:
            OutputError: If there is no room for its file.
        """
        kind = np.dtype(dtype)
        size = kind.itemsize * prod(shape)
        if self._folder is None or size == 0:
            return np.zeros(shape, kind)
        self._folder.mkdir(parents=True, exist_ok=True)
        with output_errors(self._folder), tempfile.TemporaryFile(dir=self._folder) as file:
            _make_room(file.fileno(), size)
            mapped = mmap.mmap(file.fileno(), size)
        self._maps.append(mapped)
        return np.frombuffer(mapped, kind).reshape(shape)

    def copy(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return a copy of an array.

        Raises:
            OutputError: If there is no room for its file.
        """
        if self._folder is None:
            return np.array(values)
        found = self.zeros(values.shape, values.dtype)
        found[...] = values
        return found

    def release(self) -> None:
        """Give back the memory of all arrays that lie in files; their content stays.

        Safe at any time, also while other threads read and write.
        """
        for mapped in self._maps:
            give_back(mapped, 0, len(mapped))


def _make_room(descriptor: int, size: int) -> None:
    """Give a file its size, and its place on the disk: a page without one would end the process when it is written."""
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(descriptor, 0, size)
    else:
        os.truncate(descriptor, size)
