"""Tables of a static scene as columns of bytes that compress.

Numbers that follow each other are close to each other: a column holds their differences, and each of its bytes has a
plane of its own. docs/static.md describes columns to the byte.
"""

from __future__ import annotations

import zlib

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["column", "compress", "differences"]

U8 = NDArray[np.uint8]


def differences(values: ArrayLike) -> NDArray[np.int64]:
    """Return each of N integers less the one before, folded: 2 d where d >= 0, and -2 d - 1 where not."""
    apart = np.diff(np.asarray(values, np.int64), prepend=0)
    return np.where(apart >= 0, 2 * apart, -2 * apart - 1)


def column(values: ArrayLike, width: int) -> bytes:
    """Return N integers of at most `width` bytes: the lowest byte of all, then the next of all, and on."""
    whole = np.asarray(values, np.int64)
    assert whole.size == 0 or (whole.min() >= 0 and whole.max() < 1 << 8 * width), "columns hold what fits their bytes"
    return b"".join((whole >> 8 * k).astype(np.uint8).tobytes() for k in range(width))


def compress(*parts: bytes) -> bytes:
    """Return parts behind each other, compressed: a zlib stream, which browsers call "deflate"."""
    return zlib.compress(b"".join(parts), 9)
