"""Divide the Gaussians of a static scene into parts, which are fetched whole: neighbors in space.

A box of Gaussians is cut in two across its longest side, again and again. Boxes as large as `STRATA` parts are divided
by light: the brightest Gaussians of a box come first.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["PART", "divide_in_space"]

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

PART = 1024
"""Gaussians of a part, about."""

STRATA = 2
"""Parts of a box."""

_ENDS = (0.1, 0.9)  # quantiles between which a box is measured, because a few Gaussians are far away


def divide_in_space(means: F64, gains: F64, size: int | None = None) -> list[I64]:
    """Return the parts of N Gaussians, each as ascending ids.

    Args:
        means: (N, 3) centers.
        gains: (N,) how bright each one is.
        size: Gaussians of a part, about; None means `PART`.
    """
    whole = (size or PART) * STRATA
    parts: list[I64] = []
    boxes = [np.arange(len(means))] if len(means) else []
    while boxes:
        ids = boxes.pop()
        count = round(len(ids) / whole)
        if count < 2:
            order = ids[np.argsort(-gains[ids], kind="stable")]
            strata = max(round(len(ids) / (size or PART)), 1)
            parts += [np.sort(some) for some in np.array_split(order, strata)]
            continue
        low, high = np.quantile(means[ids], _ENDS, axis=0)
        order = ids[np.argsort(means[ids, int(np.argmax(high - low))], kind="stable")]
        middle = len(ids) * (count // 2) // count
        boxes += [order[middle:], order[:middle]]
    return parts
