"""Numbers of Gaussians and of words of 64 of them, from which units are made."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.abr._kernels.units import Units

__all__ = ["level_bytes", "room", "strengths", "word_means"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


def strengths(importance: F32, nbytes: F32, areas: F32, pixel_area: float) -> F32:
    """Return (N, 2) per byte: importance times area, and importance times the area that a pixel adds at distance 1."""
    value = (importance / nbytes).astype(np.float64)
    both = np.stack([value * areas, value * pixel_area], axis=1)
    return np.minimum(both, 1e30).astype(np.float32)


def level_bytes(sums: F64, levels: int) -> F64:
    """Return the (L,) bytes of each level from (L * L,) bytes by first and last level."""
    square = sums.reshape(levels, levels)
    return np.array([square[: k + 1, k:].sum() for k in range(levels)])


def room(count: int) -> Units:
    """Return uninitialized units to write to."""
    one = np.empty(count, np.float32)
    codes = np.empty(count, np.uint16)
    numbers = np.empty(count, np.int32), np.empty(count, np.uint64)
    return Units(*numbers, one, np.empty_like(one), codes, np.empty_like(one))


def word_means(values: NDArray[Any], words: int) -> F32:
    """Return the (W,) mean of values (N,) over the Gaussians of each word."""
    out = np.ones(words, np.float32)
    starts = np.arange(0, len(values), 64)
    sums = np.add.reduceat(values, starts) if len(values) else np.zeros(0, np.float32)
    out[: len(starts)] = sums / np.minimum(64, len(values) - starts)
    return out
