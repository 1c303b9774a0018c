"""Find flyaways: Gaussians so far outside of a scene that they look too small to see.

Trained scenes have them thousands of scene sizes away. A robust box ignores a few of them in its tails; more would
enlarge it, so `Gaussians.bounds` removes them first. Frame and units are the scene's own.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["FEWEST", "find_flyaways"]

Mask = NDArray[np.bool_]

FEWEST = 0.01
"""Share of the Gaussians up to which flyaways are kept, because the tails of the 98% box absorb them."""

_LEAST = 100  # Gaussians of a scene in which shares mean something
_FAR = 3.0  # longest sides of the box of the middle half, beyond that box
_COVER = 1e-3  # share of all directions; what covers less is no part of the scene
_ONE = 0.1 * _COVER  # covered by one Gaussian at the most: a giant alone is no backdrop


def find_flyaways(
    means: NDArray[np.floating[Any]], scales: NDArray[np.floating[Any]], opacities: NDArray[np.floating[Any]]
) -> Mask:
    """Return which Gaussians are flyaways, if these are more than 1% of all; else none.

    Flyaways are the outermost Gaussians that together cover less than a thousandth of all directions from the middle.
    All are farther away than three times the longest side of the box that holds the middle half of the centers on each
    axis, so up to a fourth of the scene can be flyaways.

    Args:
        means: (N, 3) centers.
        scales: (N, 3) standard deviations.
        opacities: (N,) opacities.
    """
    found = np.zeros(len(means), bool)
    if len(means) < _LEAST:
        return found
    low, high = np.quantile(means, [0.25, 0.75], axis=0).astype(np.float64)
    longest = float((high - low).max())
    least = low - _FAR * longest
    most = high + _FAR * longest
    far = np.flatnonzero(np.any((means < least) | (means > most), axis=1))
    fewest = FEWEST * len(means)
    if longest == 0.0 or len(far) <= fewest:
        return found
    places = means[far].astype(np.float64)
    squared = np.sum((places - 0.5 * (low + high)) ** 2, axis=1)
    _, mid, largest = np.sort(scales[far].astype(np.float64), axis=1).T
    covers = np.minimum(opacities[far] * mid * largest / (2.0 * squared), _ONE)  # 2 pi mid largest over 4 pi squared
    order = np.argsort(-np.maximum(low - places, places - high).max(axis=1), kind="stable")
    count = int(np.searchsorted(np.cumsum(covers[order]), _COVER))
    if count > fewest:
        found[far[order[:count]]] = True
    return found
