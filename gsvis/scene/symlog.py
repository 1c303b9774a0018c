"""Compute the symmetric logarithm of coordinates, which SOG files quantize evenly. Scene frame and units."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["from_symlog", "symlog"]

F64 = NDArray[np.float64]


def symlog(x: ArrayLike) -> F64:
    """Return the symmetric logarithm of coordinates of any shape: sign(x) log(1 + |x|)."""
    x64 = np.asarray(x, np.float64)
    return np.asarray(np.sign(x64) * np.log1p(np.abs(x64)))


def from_symlog(u: ArrayLike) -> F64:
    """Return the coordinates of symmetric logarithms; infinite beyond the range of float64."""
    u64 = np.asarray(u, np.float64)
    with np.errstate(over="ignore"):
        return np.asarray(np.sign(u64) * np.expm1(np.abs(u64)))
