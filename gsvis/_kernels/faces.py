"""Kernel of direction sets: find which of the 80 faces of the subdivided icosahedron contains a direction.

The faces of a regular icosahedron are the Voronoi cells of their centers, so the face of a direction is the nearest
center; three planes then select one of its four parts.
"""

from __future__ import annotations

import numpy as np

from gsvis._kernels.compiled import uncounted

TOGETHER = 64
"""Directions of which `find_faces` finds the faces together."""
Y = np.uint64(TOGETHER)
Z = np.uint64(2 * TOGETHER)
FACE = np.uint64(3 * TOGETHER)
_MOST = np.uint64(4 * TOGETHER)
ROOM = 5 * TOGETHER
"""Numbers of the table of `find_faces`."""


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


@uncounted
def find_faces(count, centers, planes, table):
    """Find the faces of the first `count` of 64 directions, as `face_of` does.

    Args:
        count: Number of directions; the numbers of the others may be anything.
        centers: (20, 3), of the faces of the icosahedron.
        planes: (20, 3, 3), between their parts.
        table: (ROOM,) float64: entry k is x of direction k, entry k + Y its y, k + Z its z; entry k + FACE receives its
            face. So the compiler sees that columns do not overlap, and makes vectors of the loop.
    """
    for k in range(np.uint64(TOGETHER)):
        table[k + FACE] = 0.0
        table[k + _MOST] = -np.inf
    for f in range(20):
        x = centers[f, 0]
        y = centers[f, 1]
        z = centers[f, 2]
        for k in range(np.uint64(TOGETHER)):
            along = table[k] * x + table[k + Y] * y + table[k + Z] * z
            nearer = along > table[k + _MOST]
            table[k + FACE] = np.float64(f) if nearer else table[k + FACE]
            table[k + _MOST] = along if nearer else table[k + _MOST]
    for k in range(np.uint64(count)):
        best = np.int64(table[k + FACE])
        part = 3
        for j in range(2, -1, -1):
            side = table[k] * planes[best, j, 0] + table[k + Y] * planes[best, j, 1] + table[k + Z] * planes[best, j, 2]
            part = j if side > 0.0 else part
        table[k + FACE] = 4 * best + part
