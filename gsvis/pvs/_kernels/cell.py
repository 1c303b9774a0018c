"""Add Gaussians seen from viewpoints to the set of a cell. Arrays are checked and contiguous; world frame."""

from __future__ import annotations

from numba import uint8

from gsvis._kernels.compiled import kernel, uncounted
from gsvis._kernels.faces import face_of
from gsvis._kernels.threads import in_parts

_BLOCK = 1 << 15  # Gaussians below which one thread is enough


@uncounted
def _add(first, last, ids, classes, viewpoints, means, centers, planes, best, sets):
    """Add Gaussians first..last; see `add_seen`."""
    for k in range(first, last):
        i = ids[k]
        v = min(k, len(viewpoints) - 1)
        best[i] = max(best[i], classes[k])
        x = viewpoints[v, 0] - means[i, 0]
        y = viewpoints[v, 1] - means[i, 1]
        z = viewpoints[v, 2] - means[i, 2]
        f = face_of(x, y, z, centers, planes)
        sets[i, f >> 3] |= uint8(1 << (f & 7))


@in_parts(lambda ids, *_: (len(ids) + _BLOCK - 1) // _BLOCK)
@kernel(error_model="numpy")
def add_seen(begin, end, ids, classes, viewpoints, means, centers, planes, best, sets):
    """Add V different Gaussians to the largest classes best (N,) and the direction sets (N, 10).

    viewpoints (V, 3) are the places from which each is seen, or (1, 3) one place for all.
    """
    _add(_BLOCK * begin, min(_BLOCK * end, len(ids)), ids, classes, viewpoints, means, centers, planes, best, sets)
