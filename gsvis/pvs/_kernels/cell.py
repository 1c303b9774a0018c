"""Add Gaussians seen from viewpoints to the set of a cell. Arrays are checked and contiguous; world frame."""

from __future__ import annotations

from numba import uint8

from gsvis._kernels.compiled import kernel
from gsvis._kernels.faces import face_of


@kernel
def add_seen(ids, classes, viewpoints, means, centers, planes, best, sets):
    """Add V Gaussians to the largest classes best (N,) and the direction sets (N, 10).

    viewpoints (V, 3) are the places from which each is seen, or (1, 3) one place for all.
    """
    for k in range(len(ids)):
        i = ids[k]
        eye = viewpoints[min(k, len(viewpoints) - 1)]
        best[i] = max(best[i], classes[k])
        f = face_of(eye[0] - means[i, 0], eye[1] - means[i, 1], eye[2] - means[i, 2], centers, planes)
        sets[i, f >> 3] |= uint8(1 << (f & 7))
