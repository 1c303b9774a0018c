"""Kernel of direction sets: find which of the 80 faces of the subdivided icosahedron contains a direction.

The faces of a regular icosahedron are the Voronoi cells of their centers, so the face of a direction is the nearest
center; three planes then select one of its four parts.
"""

from __future__ import annotations

import numpy as np

from gsvis._kernels.compiled import uncounted


@uncounted
def face_of(x, y, z, centers, planes):
    """Return the face in [0, 80) that contains the direction (x, y, z), of any length > 0."""
    best = 0
    most = -np.inf
    for f in range(20):
        along = x * centers[f, 0] + y * centers[f, 1] + z * centers[f, 2]
        if along > most:
            best = f
            most = along
    for k in range(3):
        if x * planes[best, k, 0] + y * planes[best, k, 1] + z * planes[best, k, 2] > 0.0:
            return 4 * best + k
    return 4 * best + 3
