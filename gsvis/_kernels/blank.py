"""Arrays of zeros that take memory only where they are written, page by page.

The holdings of a viewer in a large world are such arrays over all ids, of which only those of nearby tiles are ever
written. `np.zeros` does not guarantee this: the C library may return used memory, and then has to clear all of it.
"""

from __future__ import annotations

import mmap
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

__all__ = ["PAGE", "blank", "blanks", "clear", "used_bytes"]

PAGE = mmap.PAGESIZE
"""Bytes of a page of memory."""

_SMALL = 1 << 18  # bytes below which `np.zeros` is used
_DENSE = 1 << 24  # bytes up to which clearing an array is faster than new pages


def blank(size: int, kind: DTypeLike) -> NDArray[Any]:
    """Return (size,) zeros that take memory, a page at a time, when an element is first written.

    Reading takes no memory. Do not write to the whole array at once.
    """
    dtype = np.dtype(kind)
    nbytes = size * dtype.itemsize
    if nbytes < _SMALL:
        return np.zeros(size, dtype)
    if not hasattr(mmap, "MAP_PRIVATE"):
        return np.frombuffer(mmap.mmap(-1, nbytes), dtype)
    block = mmap.mmap(-1, nbytes, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    if hasattr(mmap, "MADV_NOHUGEPAGE"):
        block.madvise(mmap.MADV_NOHUGEPAGE)  # else the first element may take a page of 2 MB
    return np.frombuffer(block, dtype)


def blanks(count: int, size: int, kind: DTypeLike) -> list[NDArray[Any]]:
    """Return `count` arrays of `size` zeros: small ones in one block, which is fast, large ones as from `blank`."""
    if size * np.dtype(kind).itemsize <= _DENSE:
        return list(np.zeros((count, size), kind))
    return [blank(size, kind) for _ in range(count)]


def clear(array: NDArray[Any]) -> NDArray[Any]:
    """Return an array of zeros to replace this one: the same array, cleared, or a blank one if it is large."""
    if array.nbytes > _DENSE:
        return blank(len(array), array.dtype)
    array.fill(0)
    return array


def used_bytes(array: NDArray[Any]) -> int:
    """Return the bytes of the pages of an array that are not all zeros."""
    data = array.reshape(-1).view(np.uint8)
    starts = np.arange(0, len(data), PAGE)
    return int(np.count_nonzero(np.logical_or.reduceat(data, starts)) * PAGE) if len(data) else 0
