"""Read consecutive files as one without joining them, such as a file that a package holds in parts."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from itertools import accumulate
from pathlib import Path

from gsvis.errors import FormatError
from gsvis.files.limits import DAMAGED, open_regular

__all__ = ["JoinedFiles"]


class JoinedFiles:
    """Several files as one. A file is open only while it is read, so thousands of parts take no open files.

    Args:
        paths: The files, in order.
        sizes: Bytes of each.

    Attributes:
        size: Bytes of all together.
    """

    def __init__(self, paths: Sequence[Path], sizes: Sequence[int]) -> None:
        self._paths = list(paths)
        self._starts = [0, *accumulate(sizes)]
        self.size = self._starts[-1]

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
            with open_regular(self._paths[k]) as file:
                file.seek(start - self._starts[k])
                data = file.read(stop - start)
            if len(data) < stop - start:
                size = self._starts[k + 1] - self._starts[k]
                raise FormatError(self._paths[k], "", f"{size:,} bytes", "fewer", DAMAGED)
            found.append(data)
            start = stop
        return b"".join(found)
