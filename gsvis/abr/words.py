"""Numbers of single Gaussians and of words of 64 Gaussians, from which units are made."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.abr._kernels.units import Units

__all__ = ["empty_units", "level_bytes", "strengths", "word_means"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


def strengths(importance: F32, nbytes: F32, areas: F32, pixel_area: float) -> F32:
    """Return (N, 2) float32 values of each Gaussian per byte of its record.

    The first is importance times area, the second importance times the area that a pixel adds at distance 1.

    Args:
        importance: (N,) factor on the weight.
        nbytes: (N,) bytes of each record.
        areas: (N,) mean cross-section, scene units squared.
        pixel_area: Steradians that a pixel adds.
    """
    value = (importance / nbytes).astype(np.float64)
    both = np.stack([value * areas, value * pixel_area], axis=1)
    return np.minimum(both, 1e30).astype(np.float32)


def level_bytes(sums: F64, levels: int) -> F64:
    """Return the bytes (L,) of each level, from sums (L * L,) of bytes by first and last level."""
    square = sums.reshape(levels, levels)
    return np.array([square[: k + 1, k:].sum() for k in range(levels)])


def empty_units(count: int) -> Units:
    """Return arrays for `count` units, not initialized."""
    return Units(
        slots=np.empty(count, np.int32),
        masks=np.empty(count, np.uint64),
        areas=np.empty(count, np.float32),
        pixels=np.empty(count, np.float32),
        codes=np.empty(count, np.uint16),
        logs=np.empty(count, np.float32),
    )


def word_means(values: NDArray[Any], words: int) -> F32:
    """Return the mean (W,) of values (N,) over the Gaussians of each word; 1 for a word without Gaussians."""
    out = np.ones(words, np.float32)
    starts = np.arange(0, len(values), 64)
    sums = np.add.reduceat(values, starts) if len(values) else np.zeros(0, np.float32)
    out[: len(starts)] = sums / np.minimum(64, len(values) - starts)
    return out
