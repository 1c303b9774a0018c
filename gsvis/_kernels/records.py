"""Kernels for records of 16 bytes, shared by the coders of packages and of the wire: bit fields, integer strengths."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from gsvis._kernels.compiled import inner, njit

__all__ = ["logarithms", "put", "take", "weight"]


@cache
def logarithms() -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return tables of 64 log2(i) for i up to 255, and of 64 log2(1 + 2^(-i / 64)) for i up to 511; both rounded."""
    logs = np.rint(64 * np.log2(np.maximum(np.arange(256.0), 1.0)))
    sums = np.rint(64 * np.log2(1 + np.exp2(-np.arange(512) / 64)))
    return logs.astype(np.int32), sums.astype(np.int32)


@inner(forceinline=True)
def take(low, high, bit, width):
    """Return `width` bits of a record of two words, from `bit` on."""
    if bit >= 64:
        word = high >> np.uint64(bit - 64)
    elif bit + width <= 64 or bit == 0:
        word = low >> np.uint64(bit)
    else:
        word = (low >> np.uint64(bit)) | (high << np.uint64(64 - bit))
    return np.int64(word & np.uint64((1 << width) - 1))


@njit(inline="always")
def put(bits, bit, value):
    """Write a value to a record of two words, from `bit` on, where the record is zero."""
    word = np.uint64(value)
    if bit >= 64:
        bits[1] |= word << np.uint64(bit - 64)
    else:
        bits[0] |= word << np.uint64(bit)
        if bit > 48:
            bits[1] |= word >> np.uint64(64 - bit)


@inner(forceinline=True)
def _sum(a, b, sums):
    """Return 64 log2(2^(a / 64) + 2^(b / 64)), the logarithm of a sum."""
    return max(a, b) + sums[min(abs(a - b), len(sums) - 1)]


@inner(forceinline=True)
def weight(middle, smallest, opacity, stride, logs, sums):
    """Return 64 log2 of the strength of a Gaussian whose largest scale is 1.

    Args:
        middle: Steps of the middle scale below the largest.
        smallest: Steps of the smallest scale below the largest.
        opacity: 0 to 255.
        stride: A step, in 1/64 octaves.
        logs: First table of `logarithms`.
        sums: Second table of `logarithms`.
    """
    a = -middle * stride
    b = -smallest * stride
    return logs[opacity] + _sum(_sum(a, b, sums), a + b, sums)
