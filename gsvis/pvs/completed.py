"""Complete visible sets: a cell that sees most of the Gaussians of a label gets all of them.

The rim of a set is noise: of Gaussians that the same cells see, a cell misses a few, and other cells miss others. Half
of the bytes of a set say which. A completed set shows no less, and is larger by a few hundredths (docs/design/161).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsvis.pvs import codec

__all__ = ["COMPLETE_FROM", "Completion"]

COMPLETE_FROM = 0.75
"""Share of the Gaussians of a label from which a cell gets all of them."""

Words = NDArray[np.uint64]


class Completion:
    """Completes sets by the labels of the Gaussians. Scene order.

    Args:
        labels: (N,) uint16; Gaussians that the same cells see have the same one. If all are equal, sets stay as they
            are: there is no such thing as a label that a cell does not see.
        ever: Set of the Gaussians that any cell sees, packed. Sets never get others.
    """

    def __init__(self, labels: NDArray[np.uint16], ever: Words) -> None:
        self._labels = labels
        self._ever = _unpack(ever, len(labels))
        sizes = np.bincount(labels[self._ever], minlength=1)
        self._least = np.maximum(np.ceil(COMPLETE_FROM * sizes), 1)
        self._differ = len(labels) > 0 and bool((labels != labels[0]).any())

    def __call__(self, words: Words) -> Words:
        """Return the packed set that a cell gets, from what it sees."""
        if not self._differ:
            return words
        seen = _unpack(words, len(self._labels))
        counts = np.bincount(self._labels[seen], minlength=len(self._least))
        full = (counts >= self._least)[self._labels]
        full &= self._ever
        full |= seen
        return codec.pack(np.flatnonzero(full), len(full))


def _unpack(words: Words, count: int) -> NDArray[np.bool_]:
    """Return (N,) whether a packed set has each Gaussian."""
    bits = np.unpackbits(words.astype("<u8", copy=False).view(np.uint8), count=count, bitorder="little")
    return bits.view(np.bool_)
