"""Kernels for records of 16 bytes that the coders of packages and of the wire share: bits, and strength in integers."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from gsvis._kernels.compiled import inner, njit

__all__ = ["logarithms", "put", "take", "weight"]


@cache
def logarithms() -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return 64 log2 of 0 to 255, and 64 log2(1 + 2^(-i / 64)) down to 0; both rounded."""
    logs = np.rint(64 * np.log2(np.maximum(np.arange(256.0), 1.0)))
    sums = np.rint(64 * np.log2(1 + np.exp2(-np.arange(512) / 64)))
    return logs.astype(np.int32), sums.astype(np.int32)


@inner(forceinline=True)
def take(low, high, bit, width):
    """Return some bits of a record of two words."""
    if bit >= 64:
        word = high >> np.uint64(bit - 64)
    elif bit + width <= 64 or bit == 0:
        word = low >> np.uint64(bit)
    else:
        word = (low >> np.uint64(bit)) | (high << np.uint64(64 - bit))
    return np.int64(word & np.uint64((1 << width) - 1))


@njit(inline="always")
def put(bits, bit, value):
    """Add a value to a record of two words, at a place where it is zero."""
    word = np.uint64(value)
    if bit >= 64:
        bits[1] |= word << np.uint64(bit - 64)
    else:
        bits[0] |= word << np.uint64(bit)
        if bit > 48:
            bits[1] |= word >> np.uint64(64 - bit)


@inner(forceinline=True)
def _sum(a, b, sums):
    """Return 64 log2(2^(a / 64) + 2^(b / 64))."""
    return max(a, b) + sums[min(abs(a - b), len(sums) - 1)]


@inner(forceinline=True)
def weight(middle, smallest, opacity, stride, logs, sums):
    """Return 64 log2 of the strength of a Gaussian whose largest scale is 1; scales are steps below it."""
    a = -middle * stride
    b = -smallest * stride
    return logs[opacity] + _sum(_sum(a, b, sums), a + b, sums)
