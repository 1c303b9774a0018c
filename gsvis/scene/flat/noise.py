"""Look up noise without state: a smooth table that repeats, and random numbers that depend only on integers."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["chance", "grain"]

F64 = NDArray[np.float64]

SIDE = 512


@cache
def _table() -> NDArray[np.float32]:
    """Return (SIDE, SIDE) noise of all wavelengths, mean 0 and standard deviation 1, that repeats at its borders."""
    rng = np.random.default_rng(11)
    frequency = np.hypot(np.fft.fftfreq(SIDE)[:, None], np.fft.rfftfreq(SIDE)[None, :]) * SIDE
    amplitude = np.where(frequency >= 3.0, np.maximum(frequency, 1.0) ** -1.1, 0.0)
    spectrum = amplitude * np.fft.rfft2(rng.normal(size=(SIDE, SIDE)))
    table = np.fft.irfft2(spectrum, (SIDE, SIDE))
    return np.asarray(table / table.std(), np.float32)


def grain(x: ArrayLike, y: ArrayLike) -> F64:
    """Return noise of mean 0 and standard deviation 1; it repeats after 1 along each axis."""
    columns = np.floor(np.asarray(x) * SIDE).astype(np.int64) & (SIDE - 1)
    rows = np.floor(np.asarray(y) * SIDE).astype(np.int64) & (SIDE - 1)
    return np.asarray(_table()[rows, columns], np.float64)


def chance(*integers: ArrayLike) -> F64:
    """Return a fixed random number in [0, 1) for each combination of integers."""
    mixed = np.uint64(0x9E3779B97F4A7C15)
    with np.errstate(over="ignore"):
        for each in integers:
            mixed = (mixed ^ np.asarray(each).astype(np.int64).astype(np.uint64)) * np.uint64(0xBF58476D1CE4E5B9)
            mixed = mixed ^ (mixed >> np.uint64(29))
    return np.asarray((mixed >> np.uint64(11)).astype(np.float64) / 2.0**53)
