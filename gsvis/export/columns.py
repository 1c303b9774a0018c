"""Encode tables of a static scene as columns of bytes that compress well.

Consecutive numbers are close, so a column holds their differences, with a separate plane for each byte. docs/static.md
describes columns to the byte.
"""

from __future__ import annotations

import zlib

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["GAIN_STEPS", "column", "compress", "differences", "quantize_gains"]

U8 = NDArray[np.uint8]

GAIN_STEPS = 4
"""Steps of a gain for each doubling."""


def differences(values: ArrayLike) -> NDArray[np.int64]:
    """Return zigzag-encoded differences of N integers: 2 d if d >= 0, else -2 d - 1."""
    apart = np.diff(np.asarray(values, np.int64), prepend=0)
    return np.where(apart >= 0, 2 * apart, -2 * apart - 1)


def column(values: ArrayLike, width: int) -> bytes:
    """Return N integers of at most `width` bytes as planes: the lowest bytes of all, then the next bytes, and so on."""
    whole = np.asarray(values, np.int64)
    assert whole.size == 0 or (whole.min() >= 0 and whole.max() < 1 << 8 * width), "columns hold what fits their bytes"
    return b"".join((whole >> 8 * k).astype(np.uint8).tobytes() for k in range(width))


def compress(*parts: bytes) -> bytes:
    """Return the concatenated parts, compressed: a zlib stream, which browsers call "deflate"."""
    return zlib.compress(b"".join(parts), 9)


def quantize_gains(gains: NDArray[np.float64], top: int) -> U8:
    """Return gains > 0 as bytes: 255 is 2^(top / 4), and each step below it divides by 2^(1/4), down to 1."""
    places = np.rint(GAIN_STEPS * np.log2(np.maximum(gains, np.finfo(np.float64).tiny)))
    return np.asarray(np.clip(places - top + 255, 1, 255), np.uint8)
