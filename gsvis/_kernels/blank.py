"""Arrays of zeros that take memory where somebody writes: large ones come from the system page by page.

What a viewer holds of a large world is such an array over all ids, of which only the tiles around the viewer are ever
written. NumPy's zeros are not enough: the C library may give memory that was used before, and has to clear all of it.
"""

from __future__ import annotations

import mmap
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

__all__ = ["PAGE", "blank", "blanks", "clear", "used_bytes"]

PAGE = mmap.PAGESIZE
"""Bytes that the system gives at a time."""

_SMALL = 1 << 18  # bytes below which a page more or less does not matter
_DENSE = 1 << 24  # bytes up to which clearing takes less time than pages that are given again one by one


def blank(size: int, kind: DTypeLike) -> NDArray[Any]:
    """Return (size,) zeros; memory is taken when an element is first written, a page at a time.

    Reading takes no memory. Do not change such an array by an operation over all of it.
    """
    dtype = np.dtype(kind)
    nbytes = size * dtype.itemsize
    if nbytes < _SMALL:
        return np.zeros(size, dtype)
    if not hasattr(mmap, "MAP_PRIVATE"):
        return np.frombuffer(mmap.mmap(-1, nbytes), dtype)
    block = mmap.mmap(-1, nbytes, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    if hasattr(mmap, "MADV_NOHUGEPAGE"):
        block.madvise(mmap.MADV_NOHUGEPAGE)  # else the system may give 2 MB for the first element
    return np.frombuffer(block, dtype)


def blanks(count: int, size: int, kind: DTypeLike) -> list[NDArray[Any]]:
    """Return several arrays as `blank` makes them; in one block if they are not large: huge pages are fast."""
    if size * np.dtype(kind).itemsize <= _DENSE:
        return list(np.zeros((count, size), kind))
    return [blank(size, kind) for _ in range(count)]


def clear(array: NDArray[Any]) -> NDArray[Any]:
    """Return zeros in place of an array: the same array, or a blank one if it is large."""
    if array.nbytes > _DENSE:
        return blank(len(array), array.dtype)
    array.fill(0)
    return array


def used_bytes(array: NDArray[Any]) -> int:
    """Return the bytes of the pages of an array that hold something other than zeros."""
    data = array.reshape(-1).view(np.uint8)
    starts = np.arange(0, len(data), PAGE)
    return int(np.count_nonzero(np.logical_or.reduceat(data, starts)) * PAGE) if len(data) else 0
