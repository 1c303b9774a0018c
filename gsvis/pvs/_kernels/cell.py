"""Add Gaussians seen from viewpoints to the set of a cell. Arrays are checked and contiguous; world frame."""

from __future__ import annotations

import numpy as np
from numba import uint8

from gsvis._kernels.compiled import kernel, uncounted
from gsvis._kernels.faces import FACE, ROOM, TOGETHER, Y, Z, find_faces
from gsvis._kernels.threads import in_parts

_BLOCK = 1 << 15  # Gaussians below which one thread is enough


@uncounted
def _add(first, count, ids, classes, viewpoints, means, centers, planes, table, best, sets):
    """Add `count` Gaussians, 64 at most, from the first on; see `add_seen`. `table` is room for `find_faces`."""
    for k in range(np.uint64(count)):
        n = np.uint64(first) + k
        i = ids[n]
        v = min(n, np.uint64(len(viewpoints) - 1))
        best[i] = max(best[i], classes[n])
        table[k] = viewpoints[v, 0] - means[i, 0]
        table[k + Y] = viewpoints[v, 1] - means[i, 1]
        table[k + Z] = viewpoints[v, 2] - means[i, 2]
    find_faces(count, centers, planes, table)
    for k in range(np.uint64(count)):
        f = np.int64(table[k + FACE])
        sets[ids[np.uint64(first) + k], f >> 3] |= uint8(1 << (f & 7))


@in_parts(lambda ids, *_: (len(ids) + _BLOCK - 1) // _BLOCK)
@kernel(error_model="numpy")
def add_seen(begin, end, ids, classes, viewpoints, means, centers, planes, best, sets):
    """Add V different Gaussians to the largest classes best (N,) and the direction sets (N, 10).

    viewpoints (V, 3) are the places from which each is seen, or (1, 3) one place for all.
    """
    table = np.zeros(ROOM)
    last = min(_BLOCK * end, len(ids))
    for first in range(_BLOCK * begin, last, TOGETHER):
        count = min(last - first, TOGETHER)
        _add(first, count, ids, classes, viewpoints, means, centers, planes, table, best, sets)
