"""Order points along a Morton curve, so that neighbors in the order are neighbors in space."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis._sorting import stable_order
from gsvis.scene._kernels.morton import morton

__all__ = ["morton_codes", "morton_order"]

I64 = NDArray[np.int64]
U64 = NDArray[np.uint64]


def morton_order(means: ArrayLike) -> I64:
    """Return (N,) the order of centers (N, 3) along a Morton curve over the box of the middle 98% of them."""
    points = _check.floats("means", means, ("N", 3))
    if len(points) == 0:
        return np.zeros(0, np.int64)
    low, high = np.quantile(points.astype(np.float64), [0.01, 0.99], axis=0)
    half = max(float((high - low).max()) / 2.0, 1e-9)
    return stable_order(morton_codes(points, (low + high) / 2.0, half))


def morton_codes(means: NDArray[np.float32], center: NDArray[np.float64], half: float) -> U64:
    """Return codes (N,) along a Morton curve of 2^63 cells, evenly spaced within `half` of `center` (3,).

    Args:
        means: (N, 3) positions in the frame and units of `center`.
        center: (3,) middle of the even part of the curve.
        half: Half the width of the even part, > 0; outside of it, cells are larger.
    """
    codes = np.empty(len(means), np.uint64)
    morton(*_check.read_only(means), center, half, codes)
    return codes
