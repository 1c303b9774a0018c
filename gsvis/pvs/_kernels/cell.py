"""Kernels of one cell: what a viewpoint adds to its set. Arrays are checked and contiguous; world frame."""

from __future__ import annotations

import numpy as np
from numba import njit

from gsvis._kernels.faces import face_of


@njit(cache=True, nogil=True)
def add_viewpoint(ids, weights, tau, means, viewpoint, centers, planes, best, sets):
    """Add the Gaussians that a viewpoint sees to best (N,) and the direction sets (N, 10); return how many are new."""
    new = 0
    for k in range(len(ids)):
        weight = weights[k]
        if weight < tau:
            continue
        i = ids[k]
        new += best[i] < tau
        best[i] = max(best[i], weight)
        f = face_of(viewpoint[0] - means[i, 0], viewpoint[1] - means[i, 1], viewpoint[2] - means[i, 2], centers, planes)
        sets[i, f >> 3] |= np.uint8(1 << (f & 7))
    return new
