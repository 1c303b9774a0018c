"""Estimate the bytes of a store by coding the sets of a few of its cells; writes nothing."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsvis.pvs import codec

__all__ = ["BESIDE", "DIRECTIONS_BYTES", "bytes_of_cell", "bytes_of_directions"]

BESIDE = 0.63
"""Bytes of a cell beside others, the labels of the order included, over its bytes alone (docs/design/089)."""

DIRECTIONS_BYTES = 4.5
"""Bytes of the direction set of a Gaussian in a store: 2 where eyes see it from afar, 6 in rooms."""


def bytes_of_cell(ids: NDArray[np.integer], classes: NDArray[np.uint8], count: int, num_classes: int) -> int:
    """Return the bytes of the set of a cell and its classes, coded without its neighbors.

    Args:
        ids: (V,) visible Gaussians, ascending.
        classes: (V,) uint8, class of the largest weight of each.
        count: N, the Gaussians of the store.
        num_classes: Number of classes.
    """
    words = codec.pack(ids.astype(np.int64), count)
    ranks = np.zeros(count, np.uint8)
    ranks[ids] = classes + np.uint8(1)
    return len(codec.encode_set(words)) + len(codec.encode_classes(words, ranks, None, num_classes))


def bytes_of_directions(sets: NDArray[np.uint8]) -> int:
    """Return the bytes of direction sets (N, 10)."""
    return len(codec.compress(np.ascontiguousarray(sets.T).tobytes()))
