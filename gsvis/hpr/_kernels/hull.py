"""Kernels of hidden point removal: the spherical flip, extremes per direction, and point location in a hull.

All arrays are checked and contiguous float64; the eye is the origin. A *cell* is one square of a cubemap of `size` x
`size` cells per face. A hull is `corners` (F, 3), indices into `points`, counter-clockwise seen from outside, and
`neighbors` (F, 3), the facet across the side opposite each corner.
"""

from __future__ import annotations

import numpy as np

from gsvis._kernels.compiled import inner, kernel, njit
from gsvis._kernels.threads import in_parts

_BLOCK = 4096
_MOST_STEPS = 96  # of a walk from facet to facet; longer walks are abandoned, which is always safe


@in_parts(lambda points, *_: len(points))
@kernel(error_model="numpy")
def distances(begin, end, points, eye, out):
    """Write the distance of each point from the eye into out (N,), in Open3D's order of operations."""
    for i in range(begin, end):
        x = points[i, 0] - eye[0]
        y = points[i, 1] - eye[1]
        z = points[i, 2] - eye[2]
        out[i] = np.sqrt((x * x + y * y) + z * z)


@in_parts(lambda points, *_: len(points))
@kernel(error_model="numpy")
def flip(begin, end, points, eye, lengths, radius, out):
    """Write the spherical flip p + 2 (R - |p|) p / |p| of points seen from the eye into out (N, 3)."""
    for i in range(begin, end):
        x = points[i, 0] - eye[0]
        y = points[i, 1] - eye[1]
        z = points[i, 2] - eye[2]
        twice = 2.0 * (radius - lengths[i])
        out[i, 0] = x + twice * x / lengths[i]
        out[i, 1] = y + twice * y / lengths[i]
        out[i, 2] = z + twice * z / lengths[i]


@njit(cache=True, inline="always")
def cell_of(x, y, z, size):
    """Return the cell of a direction (any length; a zero vector belongs to the first cell of the third face)."""
    ax = abs(x)
    ay = abs(y)
    az = abs(z)
    if ax >= ay and ax >= az and ax > 0.0:
        face = 0 if x > 0.0 else 1
        u = y / ax
        v = z / ax
    elif ay >= az and ay > 0.0:
        face = 2 if y > 0.0 else 3
        u = x / ay
        v = z / ay
    else:
        scale = az if az > 0.0 else 1.0
        face = 4 if z > 0.0 else 5
        u = x / scale
        v = y / scale
    column = min(int((u + 1.0) * 0.5 * size), size - 1)
    row = min(int((v + 1.0) * 0.5 * size), size - 1)
    return (face * size + row) * size + column


@njit(cache=True, inline="always")
def direction_on_face(face, u, v):
    """Return the direction of a place (u, v) in [-1, 1]^2 on a face of the cubemap, not of unit length."""
    sign = 1.0 if face % 2 == 0 else -1.0
    if face < 2:
        return sign, u, v
    if face < 4:
        return u, sign, v
    return u, v, sign


@njit(cache=True, inline="always")
def direction_of(cell, size):
    """Return the direction of a cell's center, not of unit length."""
    face = cell // (size * size)
    rest = cell % (size * size)
    return direction_on_face(face, (rest % size + 0.5) * 2.0 / size - 1.0, (rest // size + 0.5) * 2.0 / size - 1.0)


@in_parts(lambda flipped, *_: len(flipped))
@kernel(error_model="numpy")
def cells_of(begin, end, flipped, size, out):
    """Write the cell of each flipped point (M, 3) into out (M,)."""
    for i in range(begin, end):
        out[i] = cell_of(flipped[i, 0], flipped[i, 1], flipped[i, 2], size)


@kernel
def sort_by_cell(cells, count, out):
    """Write the indices of the points, sorted by cell (M,), into out (M,); stable within a cell.

    Returns (count + 1,), the start of each cell.
    """
    begins = np.zeros(count + 1, np.int64)
    for cell in cells:
        begins[cell + 1] += 1
    for cell in range(count):
        begins[cell + 1] += begins[cell]
    place = begins[:-1].copy()
    for i in range(len(cells)):
        out[place[cells[i]]] = i
        place[cells[i]] += 1
    return begins


@in_parts(lambda points, order, out: len(order))
@kernel(error_model="numpy")
def gather(begin, end, points, order, out):
    """Copy points in the given order into the first rows of out."""
    for i in range(begin, end):
        for k in range(3):
            out[i, k] = points[order[i], k]


@in_parts(lambda flipped, begins, *_: len(begins) - 1)
@kernel(error_model="numpy")
def farthest_in_cells(begin, end, flipped, begins, out_position, out_squared):
    """Find the farthest flipped point of each cell and its squared distance, -1 in empty cells.

    Points are in the order of cells; the first of a tie counts.
    """
    for cell in range(begin, end):
        out_position[cell] = -1
        out_squared[cell] = -1.0
        for i in range(begins[cell], begins[cell + 1]):
            far = flipped[i, 0] ** 2 + flipped[i, 1] ** 2 + flipped[i, 2] ** 2
            if far > out_squared[cell]:
                out_position[cell] = i
                out_squared[cell] = far


@njit(cache=True, inline="always")
def _above(points, a, b, c, x, y, z, band):
    """Return on which side of the plane of a, b, c a place lies: 1 above, -1 below, 0 within `band`.

    a, b, c are counter-clockwise from outside. `band` is a distance. A degenerate plane (a sliver) gives 0.
    """
    ux = points[b, 0] - points[a, 0]
    uy = points[b, 1] - points[a, 1]
    uz = points[b, 2] - points[a, 2]
    vx = points[c, 0] - points[a, 0]
    vy = points[c, 1] - points[a, 1]
    vz = points[c, 2] - points[a, 2]
    nx = uy * vz - uz * vy
    ny = uz * vx - ux * vz
    nz = ux * vy - uy * vx
    side = nx * (x - points[a, 0]) + ny * (y - points[a, 1]) + nz * (z - points[a, 2])
    if side * side <= band * band * (nx * nx + ny * ny + nz * nz):
        return 0
    return 1 if side > 0.0 else -1


@njit(cache=True, inline="always")
def _outside_cone(points, a, b, inner, x, y, z):
    """Return how far (x, y, z) - inner lies on the outer side of the plane through inner, a and b; not to scale."""
    ax = points[a, 0] - inner[0]
    ay = points[a, 1] - inner[1]
    az = points[a, 2] - inner[2]
    bx = points[b, 0] - inner[0]
    by = points[b, 1] - inner[1]
    bz = points[b, 2] - inner[2]
    return -(
        (ay * bz - az * by) * (x - inner[0])
        + (az * bx - ax * bz) * (y - inner[1])
        + (ax * by - ay * bx) * (z - inner[2])
    )


@inner
def locate(points, corners, neighbors, start, most, inner, slack, x, y, z):
    """Return the facet through which the ray from `inner` toward a place leaves the hull; -1 after too many steps.

    `slack` is the rounding error of a product of three lengths: without it a ray through a corner circles forever.
    """
    f = start
    for _ in range(most):
        a = corners[f, 0]
        b = corners[f, 1]
        c = corners[f, 2]
        across_a = _outside_cone(points, b, c, inner, x, y, z)
        across_b = _outside_cone(points, c, a, inner, x, y, z)
        across_c = _outside_cone(points, a, b, inner, x, y, z)
        if across_a <= slack and across_b <= slack and across_c <= slack:
            return f
        if across_a >= across_b and across_a >= across_c:
            f = neighbors[f, 0]
        elif across_b >= across_c:
            f = neighbors[f, 1]
        else:
            f = neighbors[f, 2]
    return -1


@kernel
def insert(points, chosen, corners, neighbors, state, inner, slack, band, doubtful):
    """Add the points chosen (M,) to a convex hull, one by one, in place.

    corners (F, 3) index `points`, counter-clockwise seen from outside; neighbors[f, k] lies across the side opposite
    corner k. `state` is [facets, facet to start from, doubtful]: the first `facets` rows are in use. A point within
    `band` of the hull's boundary is left out and recorded in `doubtful`, unless it coincides with a corner. Returns 0,
    or 1 if rounding has broken the topology.
    """
    facets = state[0]
    last = state[1]
    doubts = state[2]
    visited = np.zeros(len(corners), np.int32)  # stamp; negative: tested and not visible
    first_at = np.zeros(len(points), np.int32)  # new facet that starts at a point, if stamped
    next_at = np.zeros(len(points), np.int32)
    stamp_at = np.full(len(points), -1, np.int32)
    visible = np.empty(64, np.int32)
    rim = np.empty((64, 3), np.int32)
    holes = np.empty(64, np.int32)
    free = 0
    for step in range(len(chosen)):
        p = chosen[step]
        stamp = step + 1
        x = points[p, 0]
        y = points[p, 1]
        z = points[p, 2]
        f = locate(points, corners, neighbors, last, facets + 16, inner, slack, x, y, z)
        if f < 0:
            return 1
        last = f
        side = _above(points, corners[f, 0], corners[f, 1], corners[f, 2], x, y, z, band)
        if side < 0:
            continue
        if side == 0:
            twin = False
            for k in range(3):
                v = corners[f, k]
                twin = twin or (points[v, 0] == x and points[v, 1] == y and points[v, 2] == z)
            if not twin:
                if doubts < len(doubtful):
                    doubtful[doubts] = p
                doubts += 1
            continue
        visited[f] = stamp
        visible[0] = f
        found = 1
        edges = 0
        k = 0
        while k < found:
            f = visible[k]
            k += 1
            for corner in range(3):
                g = neighbors[f, corner]
                if visited[g] == stamp:
                    continue
                if visited[g] != -stamp:
                    side = _above(points, corners[g, 0], corners[g, 1], corners[g, 2], x, y, z, 0.0)
                    if side > 0:
                        if found == len(visible):
                            visible = np.concatenate((visible, np.empty_like(visible)))
                        visited[g] = stamp
                        visible[found] = g
                        found += 1
                        continue
                    visited[g] = -stamp
                if edges == len(rim):
                    rim = np.concatenate((rim, np.empty_like(rim)))
                rim[edges, 0], rim[edges, 1] = corners[f, (corner + 1) % 3], corners[f, (corner + 2) % 3]
                rim[edges, 2] = g
                edges += 1
        while free + found < edges:  # removed facets come first, then new rows
            if facets == len(corners):
                return 1
            if free == len(holes):
                holes = np.concatenate((holes, np.empty_like(holes)))
            holes[free] = facets
            facets = facets + 1
            free = free + 1
        for k in range(found):
            if free == len(holes):
                holes = np.concatenate((holes, np.empty_like(holes)))
            holes[free] = visible[k]
            corners[visible[k], 0] = -1
            free += 1
        for e in range(edges):
            u = rim[e, 0]
            if stamp_at[u] == stamp:
                return 1
            free -= 1
            stamp_at[u], first_at[u], next_at[u] = stamp, holes[free], rim[e, 1]
        u = rim[0, 0]
        for e in range(edges):  # the rim is one closed line
            if stamp_at[u] != stamp or (e > 0 and u == rim[0, 0]):
                return 1
            u = next_at[u]
        if u != rim[0, 0]:
            return 1
        for e in range(edges):
            u = rim[e, 0]
            w = rim[e, 1]
            g = rim[e, 2]
            f = first_at[u]
            following = first_at[w]
            for k in range(3):  # the side of g whose ends are w and u
                if corners[g, (k + 1) % 3] == w and corners[g, (k + 2) % 3] == u:
                    neighbors[g, k] = f
            neighbors[f, 0] = following
            neighbors[f, 2] = g
            neighbors[following, 1] = f
        for e in range(edges):
            f = first_at[rim[e, 0]]
            corners[f, 0], corners[f, 1], corners[f, 2] = rim[e, 0], rim[e, 1], p
            visited[f] = 0
        last = first_at[rim[0, 0]]
    if free > 0:
        facets, last = _close_up(corners, neighbors, facets, last)
    state[0] = facets
    state[1] = last
    state[2] = doubts
    return 0


@inner
def _close_up(corners, neighbors, facets, last):
    """Compact the live facets (first corner not -1); return their number, and the new index of facet `last`."""
    place = np.empty(facets, np.int32)
    count = 0
    for f in range(facets):
        place[f] = count
        if corners[f, 0] >= 0:
            for k in range(3):
                corners[count, k], neighbors[count, k] = corners[f, k], neighbors[f, k]
            count += 1
    for f in range(count):
        for k in range(3):
            neighbors[f, k] = place[neighbors[f, k]]
    return count, place[last]


@kernel
def count_creases(points, corners, neighbors, band, out):
    """Count the sides of facets at which the hull bends by more than `band` into out (N,), at both their ends.

    A corner with a count below three lies within about `band` of the hull of the other corners. Returns 1 if the hull
    bends inward by more than `band`, which means that rounding has broken it.
    """
    for f in range(len(corners)):
        a = corners[f, 0]
        b = corners[f, 1]
        c = corners[f, 2]
        for k in range(3):
            g = neighbors[f, k]
            if g < f:
                continue
            v = corners[g, 0]
            if v in (a, b, c):
                v = corners[g, 1]
            if v in (a, b, c):
                v = corners[g, 2]
            side = _above(points, a, b, c, points[v, 0], points[v, 1], points[v, 2], band)
            if side > 0:
                return 1
            if side < 0:
                out[corners[f, (k + 1) % 3]] += 1
                out[corners[f, (k + 2) % 3]] += 1
    return 0


@kernel
def facets_of_cells(points, corners, neighbors, inner, slack, reach, size, out):
    """Write a facet near the direction of each cell into out (6 size^2,): one with a corner in it, or at its center."""
    out[:] = -1
    for f in range(len(corners)):
        for k in range(3):
            v = corners[f, k]
            out[cell_of(points[v, 0], points[v, 1], points[v, 2], size)] = f
    last = np.int64(0)
    for cell in range(len(out)):
        if out[cell] < 0:
            x, y, z = direction_of(cell, size)
            f = locate(points, corners, neighbors, last, len(corners), inner, slack, x * reach, y * reach, z * reach)
            out[cell] = f if f >= 0 else last
        last = np.int64(out[cell])


@in_parts(lambda *arguments: (len(arguments[-1]) + _BLOCK - 1) // _BLOCK)
@kernel(error_model="numpy")
def not_inside(begin, end, points, corners, neighbors, starts, size, inner, slack, band, out):
    """Write whether each of the first M points may lie outside the hull into out (M,); False is certain."""
    most = np.int64(_MOST_STEPS)  # a literal would compile `locate` once more
    for block in range(begin, end):
        for i in range(block * _BLOCK, min(len(out), (block + 1) * _BLOCK)):
            x = points[i, 0]
            y = points[i, 1]
            z = points[i, 2]
            start = np.int64(starts[cell_of(x, y, z, size)])
            f = locate(points, corners, neighbors, start, most, inner, slack, x, y, z)
            out[i] = f < 0 or _above(points, corners[f, 0], corners[f, 1], corners[f, 2], x, y, z, band) >= 0


@in_parts(lambda directions, *_: len(directions))
@kernel(error_model="numpy")
def radial(begin, end, directions, points, corners, neighbors, starts, size, inner, slack, out):
    """Write distances of the hull's boundary from the eye along unit directions (D, 3) into out (D,); 0 if unknown."""
    for i in range(begin, end):
        x = directions[i, 0]
        y = directions[i, 1]
        z = directions[i, 2]
        out[i] = 0.0
        start = np.int64(starts[cell_of(x, y, z, size)])
        f = locate(points, corners, neighbors, start, len(corners), inner, slack, x, y, z)
        if f < 0:
            continue
        a = points[corners[f, 0]]
        b = points[corners[f, 1]]
        c = points[corners[f, 2]]
        ux = b[0] - a[0]
        uy = b[1] - a[1]
        uz = b[2] - a[2]
        vx = c[0] - a[0]
        vy = c[1] - a[1]
        vz = c[2] - a[2]
        nx = uy * vz - uz * vy
        ny = uz * vx - ux * vz
        nz = ux * vy - uy * vx
        toward = nx * x + ny * y + nz * z
        if toward > 0.0:
            out[i] = (nx * a[0] + ny * a[1] + nz * a[2]) / toward
