"""Sort weights into classes: those of a visible set, from tau upward, and those of what is too faint for one."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["FAINTEST", "UNSEEN", "WeightClasses"]

FAINTEST = -6
"""Lowest class that is kept; -1 reaches from half of tau up to tau, each class below it has half the weight."""

UNSEEN = FAINTEST - 1
"""Class of what is fainter still, or was not found."""


class WeightClasses:
    """The classes of weights.

    Args:
        edges: (K,) lowest weights of the classes of a visible set, ascending from tau.
    """

    def __init__(self, edges: ArrayLike) -> None:
        seen = np.asarray(edges, np.float64)
        faint = seen[0] * 2.0 ** np.arange(FAINTEST, 0)
        self._edges = np.concatenate([faint, seen]).astype(np.float32)

    @property
    def faintest(self) -> float:
        """Least weight that has a class."""
        return float(self._edges[0])

    def of(self, weights: NDArray[np.float32]) -> NDArray[np.int8]:
        """Return the class of each weight (V,): 0..K - 1 from tau upward, negative below, `UNSEEN` for the least."""
        classes = np.full(len(weights), UNSEEN, np.int8)
        for edge in self._edges:  # faster than a search, as there are few
            classes += weights >= edge
        return classes
