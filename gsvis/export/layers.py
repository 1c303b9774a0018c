"""Divide the terms of a block into layers that an eye is likely to need together.

The first two terms of a Gaussian count most and have their own layer. A term changes colors only in a cone of
directions, so the other terms have four layers by the direction of their lobes. One eye needs only some layers.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsvis.color.srbf import unit_vectors
from gsvis.export.blocks import Blocks
from gsvis.package.contents import Contents

__all__ = ["LAYERS", "items_of"]

LAYERS = 5
"""Layers of the terms of a block."""

_FIRST = 2  # terms of a Gaussian
_CORNERS = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], np.float64)  # of a tetrahedron


def items_of(contents: Contents, blocks: Blocks) -> NDArray[np.int64]:
    """Return the item (T,) of each term: the number of its block, plus B for each layer below its own.

    Args:
        contents: A package of T terms.
        blocks: Its B blocks.
    """
    owners = np.repeat(blocks.of_ids, contents.term_counts).astype(np.int64)
    places = np.arange(len(owners)) - np.repeat(contents.term_offsets[:-1], contents.term_counts)
    facing = np.argmax(unit_vectors(contents.colors().dequantize().centers) @ _CORNERS.T, axis=1)
    return np.asarray(owners + len(blocks) * np.where(places < _FIRST, 0, 1 + facing), np.int64)
