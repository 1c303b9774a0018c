"""Kernel of the Morton curve: places of points along it.

Arrays are checked and contiguous. Knows no Gaussians.
"""

from __future__ import annotations

import numpy as np

from gsvis._kernels.compiled import kernel

__all__ = ["morton"]


@kernel
def morton(means, center, half, out):
    """Write codes (N,) uint64 along a Morton curve of 2^63 cells, evenly spaced within `half` of the center (3,)."""
    for i in range(len(means)):
        code = np.uint64(0)
        for axis in range(3):
            u = (np.float64(means[i, axis]) - center[axis]) / half
            if u > 1.0:
                u = 2.0 - 1.0 / u
            elif u < -1.0:
                u = -2.0 - 1.0 / u
            cell = np.uint64(min(max((u + 2.0) * 524288.0, 0.0), 2097151.0))
            cell = (cell | (cell << np.uint64(32))) & np.uint64(0x1F00000000FFFF)
            cell = (cell | (cell << np.uint64(16))) & np.uint64(0x1F0000FF0000FF)
            cell = (cell | (cell << np.uint64(8))) & np.uint64(0x100F00F00F00F00F)
            cell = (cell | (cell << np.uint64(4))) & np.uint64(0x10C30C30C30C30C3)
            cell = (cell | (cell << np.uint64(2))) & np.uint64(0x1249249249249249)
            code |= cell << np.uint64(axis)
        out[i] = code
