"""Read consecutive files as one without joining them, such as a file that a package holds in parts."""

from __future__ import annotations

import os
from bisect import bisect_right
from collections.abc import Sequence
from contextlib import ExitStack
from io import BufferedReader
from itertools import accumulate
from pathlib import Path

from gsvis.errors import FormatError
from gsvis.files.limits import DAMAGED, open_regular

__all__ = ["JoinedFiles"]


class JoinedFiles:
    """Several files as one. Threads may share it.

    Args:
        paths: The files, in order.
        sizes: Bytes of each.
        is_held: Whether to keep the files open until `close`, so that their content can be read after they were removed
            or replaced. Otherwise a file is open only while it is read, so that thousands of them take no open files.
            Files are not held where the system cannot read from a place (`os.pread`).

    Attributes:
        size: Bytes of all together.
    """

    def __init__(self, paths: Sequence[Path], sizes: Sequence[int], *, is_held: bool = False) -> None:
        self._paths = list(paths)
        self._starts = [0, *accumulate(sizes)]
        self.size = self._starts[-1]
        self._opened = ExitStack()
        self._held: list[BufferedReader] = []
        if is_held and hasattr(os, "pread"):
            with ExitStack() as stack:
                self._held = [stack.enter_context(open_regular(path)) for path in self._paths]
                self._opened = stack.pop_all()

    def close(self) -> None:
        """Close the files that are held."""
        self._opened.close()

    def read(self, start: int, length: int) -> bytes:
        """Return bytes from a place on; fewer at the end.

        Raises:
            FormatError: If a file that is read is no file, or shorter than it should be.
            OSError: If it cannot be read.
        """
        end = min(start + length, self.size)
        found = []
        while start < end:
            k = bisect_right(self._starts, start) - 1
            stop = min(end, self._starts[k + 1])
            data = self._read_file(k, start - self._starts[k], stop - start)
            if len(data) < stop - start:
                size = self._starts[k + 1] - self._starts[k]
                raise FormatError(self._paths[k], "", f"{size:,} bytes", "fewer", DAMAGED)
            found.append(data)
            start = stop
        return b"".join(found)

    def _read_file(self, k: int, start: int, length: int) -> bytes:
        """Return bytes of one file from a place on; fewer at its end."""
        if self._held:
            return os.pread(self._held[k].fileno(), length, start)
        with open_regular(self._paths[k]) as file:
            file.seek(start)
            return file.read(length)
