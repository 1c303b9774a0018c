"""Kernels of hidden point removal: the spherical flip, extremes per direction, and the place of points under a hull.

All arrays are checked and contiguous float64, the eye is the origin. A *cell* is one square of a cubemap of `size` x
`size` cells a face. `facets` holds one row of 16 per triangle of a convex hull that has the eye inside or on it: the
three inward normals of the sides of the cone over it (9), its outward plane (4), and three unused numbers.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

_BLOCK = 4096
_MOST_STEPS = 96  # of a walk from facet to facet; what takes longer is given up, which is always safe


@njit(cache=True, nogil=True, parallel=True)
def distances(points, eye, out):
    """Distance of each point from the eye, into out (N,), in the order of operations that Open3D uses."""
    for i in prange(len(points)):
        x, y, z = points[i, 0] - eye[0], points[i, 1] - eye[1], points[i, 2] - eye[2]
        out[i] = np.sqrt((x * x + y * y) + z * z)


@njit(cache=True, nogil=True, parallel=True)
def flip(points, eye, lengths, radius, out):
    """Spherical flip p + 2 (R - |p|) p / |p| of points seen from the eye, into out (N, 3); same rounding as Open3D."""
    for i in prange(len(points)):
        x, y, z = points[i, 0] - eye[0], points[i, 1] - eye[1], points[i, 2] - eye[2]
        twice = 2.0 * (radius - lengths[i])
        out[i, 0] = x + twice * x / lengths[i]
        out[i, 1] = y + twice * y / lengths[i]
        out[i, 2] = z + twice * z / lengths[i]


@njit(cache=True, inline="always")
def cell_of(x, y, z, size):
    """Cell of a direction (any length; a zero vector is given the first cell of the third face)."""
    ax, ay, az = abs(x), abs(y), abs(z)
    if ax >= ay and ax >= az and ax > 0.0:
        face, u, v = (0 if x > 0.0 else 1), y / ax, z / ax
    elif ay >= az and ay > 0.0:
        face, u, v = (2 if y > 0.0 else 3), x / ay, z / ay
    else:
        scale = az if az > 0.0 else 1.0
        face, u, v = (4 if z > 0.0 else 5), x / scale, y / scale
    column = min(int((u + 1.0) * 0.5 * size), size - 1)
    row = min(int((v + 1.0) * 0.5 * size), size - 1)
    return (face * size + row) * size + column


@njit(cache=True, inline="always")
def direction_of(cell, size):
    """Direction of a cell's centre, not of unit length."""
    face, rest = cell // (size * size), cell % (size * size)
    u = (rest % size + 0.5) * 2.0 / size - 1.0
    v = (rest // size + 0.5) * 2.0 / size - 1.0
    sign = 1.0 if face % 2 == 0 else -1.0
    if face < 2:
        return sign, u, v
    if face < 4:
        return u, sign, v
    return u, v, sign


@njit(cache=True, nogil=True, parallel=True)
def farthest_in_cells(flipped, chosen, size, parts):
    """The farthest of the flipped points chosen (M,) in each cell: (6 size^2,) positions, -1 in empty cells.

    Of equally far ones the first counts, whatever the number of parts (which are searched side by side).
    """
    cells = 6 * size * size
    best = np.full((parts, cells), -1, np.int64)
    squared = np.full((parts, cells), -1.0)
    step = (len(chosen) + parts - 1) // parts
    for part in prange(parts):
        for k in range(part * step, min(len(chosen), (part + 1) * step)):
            i = chosen[k]
            x, y, z = flipped[i, 0], flipped[i, 1], flipped[i, 2]
            cell = cell_of(x, y, z, size)
            far = x * x + y * y + z * z
            if far > squared[part, cell]:
                squared[part, cell], best[part, cell] = far, i
    for part in range(1, parts):
        for cell in range(cells):
            if squared[part, cell] > squared[0, cell]:
                squared[0, cell], best[0, cell] = squared[part, cell], best[part, cell]
    return best[0]


@njit(cache=True, nogil=True)
def cones(vertices, simplices, equations, out):
    """Rows of `facets` (F, 16); a triangle whose plane passes through the eye is given a plane of zeros."""
    reach = 0.0
    for i in range(len(vertices)):
        for k in range(3):
            reach = max(reach, abs(vertices[i, k]))
    for f in range(len(simplices)):
        a, b, c = vertices[simplices[f, 0]], vertices[simplices[f, 1]], vertices[simplices[f, 2]]
        row = out[f]
        row[:] = 0.0
        row[0], row[1], row[2] = b[1] * c[2] - b[2] * c[1], b[2] * c[0] - b[0] * c[2], b[0] * c[1] - b[1] * c[0]
        row[3], row[4], row[5] = c[1] * a[2] - c[2] * a[1], c[2] * a[0] - c[0] * a[2], c[0] * a[1] - c[1] * a[0]
        row[6], row[7], row[8] = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
        volume = row[0] * a[0] + row[1] * a[1] + row[2] * a[2]
        if volume < 0.0:
            row[:9] *= -1.0
        if abs(volume) > 1e-12 * reach**3 * 1e-6 and equations[f, 3] < -1e-12 * reach:
            row[9:13] = equations[f]


@njit(cache=True, inline="always")
def _walk(facets, neighbors, start, most, x, y, z):
    """The facet whose cone holds the direction, or -1 where a walk of at most `most` steps ends at none."""
    f = start
    for _ in range(most):
        row = facets[f]
        if row[12] == 0.0:  # a plane through the eye: no distance along the direction
            return -1
        p = row[0] * x + row[1] * y + row[2] * z
        q = row[3] * x + row[4] * y + row[5] * z
        r = row[6] * x + row[7] * y + row[8] * z
        if p >= 0.0 and q >= 0.0 and r >= 0.0:
            return f
        if p <= q and p <= r:
            f = neighbors[f, 0]
        elif q <= r:
            f = neighbors[f, 1]
        else:
            f = neighbors[f, 2]
    return -1


@njit(cache=True, nogil=True)
def facet_table(facets, neighbors, size, first):
    """(6 size^2,) the facet in the direction of each cell's centre, `first` where none was found: starts of walks."""
    table = np.empty(6 * size * size, np.int32)
    last = first
    for cell in range(len(table)):
        x, y, z = direction_of(cell, size)
        f = _walk(facets, neighbors, last, len(facets), x, y, z)
        if f < 0:
            f = _walk(facets, neighbors, first, len(facets), x, y, z)
        last = f if f >= 0 else first
        table[cell] = last
    return table


@njit(cache=True, nogil=True, parallel=True)
def not_inside(flipped, chosen, facets, neighbors, table, size, margin, out):
    """Whether each flipped point chosen (M,) may lie outside the hull, into out (M,); False is certain by the margin."""
    for block in prange((len(chosen) + _BLOCK - 1) // _BLOCK):
        for k in range(block * _BLOCK, min(len(chosen), (block + 1) * _BLOCK)):
            i = chosen[k]
            x, y, z = flipped[i, 0], flipped[i, 1], flipped[i, 2]
            f = _walk(facets, neighbors, table[cell_of(x, y, z, size)], _MOST_STEPS, x, y, z)
            out[k] = True
            if f >= 0:
                row = facets[f]
                out[k] = row[9] * x + row[10] * y + row[11] * z + row[12] >= -margin
