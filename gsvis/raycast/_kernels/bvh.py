"""Kernels that build an eight-wide bounding volume hierarchy over boxes.

A node stores eight children together, so that one vector instruction tests a ray against all of them. A child is
another node or a single Gaussian. The boxes are float32, rounded outward. World frame, scene units. Knows only boxes.
"""

from __future__ import annotations

import numpy as np

from gsvis._kernels.compiled import inner, njit

WIDTH = 8
_BINS = 16
MOST_LEVELS = 56  # bound that `build` keeps: _DEEP by area, then at most log2 of 2^31 boxes by halving
_DEEP = 24


@inner
def _area(lo, hi):
    """Return half the surface area of a box."""
    x = hi[0] - lo[0]
    y = hi[1] - lo[1]
    z = hi[2] - lo[2]
    return x * y + y * z + z * x


@inner
def _bounds(order, start, stop, lo, hi, out_lo, out_hi):
    """Write the box around boxes order[start:stop] into out_lo and out_hi."""
    out_lo[:] = np.inf
    out_hi[:] = -np.inf
    for i in range(start, stop):
        g = order[i]
        for a in range(3):
            out_lo[a] = min(out_lo[a], lo[g, a])
            out_hi[a] = max(out_hi[a], hi[g, a])


@njit(cache=True)
def _split(order, start, stop, lo, hi):
    """Partition order[start:stop] by the binned surface area heuristic; return the first index of the right part."""
    c_lo = np.full(3, np.inf)
    c_hi = np.full(3, -np.inf)
    for i in range(start, stop):
        g = order[i]
        for a in range(3):
            c = np.float64(lo[g, a]) + np.float64(hi[g, a])
            c_lo[a] = min(c_lo[a], c)
            c_hi[a] = max(c_hi[a], c)
    count = np.zeros((3, _BINS), np.int64)
    b_lo = np.full((3, _BINS, 3), np.float32(np.inf), np.float32)
    b_hi = np.full((3, _BINS, 3), np.float32(-np.inf), np.float32)
    scale = np.zeros(3)
    for a in range(3):
        extent = c_hi[a] - c_lo[a]
        scale[a] = _BINS * (1.0 - 1e-9) / extent if extent > 0.0 else 0.0
    for i in range(start, stop):
        g = order[i]
        for a in range(3):
            k = int((np.float64(lo[g, a]) + np.float64(hi[g, a]) - c_lo[a]) * scale[a])
            count[a, k] += 1
            for e in range(3):
                b_lo[a, k, e] = min(b_lo[a, k, e], lo[g, e])
                b_hi[a, k, e] = max(b_hi[a, k, e], hi[g, e])
    best = np.inf
    best_axis = -1
    best_bin = 0
    left_cost = np.empty(_BINS)
    run_lo = np.empty(3, np.float32)
    run_hi = np.empty(3, np.float32)
    for a in range(3):
        if scale[a] == 0.0:
            continue
        run_lo[:] = np.inf
        run_hi[:] = -np.inf
        total = 0
        for k in range(_BINS - 1):
            total += count[a, k]
            for e in range(3):
                run_lo[e] = min(run_lo[e], b_lo[a, k, e])
                run_hi[e] = max(run_hi[e], b_hi[a, k, e])
            left_cost[k] = total * _area(run_lo, run_hi) if total > 0 else np.inf
        run_lo[:] = np.inf
        run_hi[:] = -np.inf
        total = 0
        for k in range(_BINS - 1, 0, -1):
            total += count[a, k]
            for e in range(3):
                run_lo[e] = min(run_lo[e], b_lo[a, k, e])
                run_hi[e] = max(run_hi[e], b_hi[a, k, e])
            if total > 0:
                cost = left_cost[k - 1] + total * _area(run_lo, run_hi)
                if cost < best:
                    best = cost
                    best_axis = a
                    best_bin = k
    if best_axis < 0:  # all centers coincide (or a box is not finite): halve by position
        return (start + stop) // 2
    i = start
    j = stop - 1
    while i <= j:
        g = order[i]
        k = int((np.float64(lo[g, best_axis]) + np.float64(hi[g, best_axis]) - c_lo[best_axis]) * scale[best_axis])
        if k < best_bin:
            i += 1
        else:
            order[i], order[j] = order[j], order[i]
            j -= 1
    return i


@njit(cache=True)
def build(lo, hi):
    """Build the hierarchy over boxes lo, hi (N, 3) float32.

    Returns:
        order: (N,) int64; position in the hierarchy -> box.
        boxes: (M, 6, 8) float32; lowest x y z and highest x y z of the eight children of each node.
        children: (M, 8) int64; a node if >= 0, else box number -1 - position; empty children have +inf in all six.

    No path is longer than MOST_LEVELS: below _DEEP levels ranges are halved, so that no input can overflow the stack of
    a traversal.
    """
    n = len(lo)
    order = np.arange(n)
    capacity = max(1, n)  # every node but a lone root has at least two children
    boxes = np.empty((capacity, 6, WIDTH), np.float32)
    children = np.full((capacity, WIDTH), -1, np.int64)
    boxes[0] = np.inf
    if n == 0:
        return order, boxes[:1].copy(), children[:1].copy()
    todo_node = np.empty(n + 1, np.int64)
    todo_start = np.empty(n + 1, np.int64)
    todo_stop = np.empty(n + 1, np.int64)
    todo_level = np.empty(n + 1, np.int64)
    todo_node[0] = 0
    todo_start[0] = 0
    todo_stop[0] = n
    todo_level[0] = 1
    todo = 1
    nodes = 1
    starts = np.empty(WIDTH, np.int64)
    stops = np.empty(WIDTH, np.int64)
    part_lo = np.empty((WIDTH, 3), np.float32)
    part_hi = np.empty((WIDTH, 3), np.float32)
    while todo > 0:
        todo -= 1
        node = todo_node[todo]
        level = todo_level[todo]
        starts[0], stops[0] = todo_start[todo], todo_stop[todo]
        _bounds(order, starts[0], stops[0], lo, hi, part_lo[0], part_hi[0])
        parts = 1
        while parts < WIDTH:
            pick = -1
            largest = -1.0
            for p in range(parts):
                if stops[p] - starts[p] > 1:
                    size = _area(part_lo[p], part_hi[p])
                    if size > largest:
                        pick = p
                        largest = size
            if pick < 0:
                break
            middle = (starts[pick] + stops[pick]) // 2
            if level <= _DEEP:
                middle = _split(order, starts[pick], stops[pick], lo, hi)
            starts[parts], stops[parts] = middle, stops[pick]
            stops[pick] = middle
            _bounds(order, starts[pick], stops[pick], lo, hi, part_lo[pick], part_hi[pick])
            _bounds(order, starts[parts], stops[parts], lo, hi, part_lo[parts], part_hi[parts])
            parts += 1
        boxes[node] = np.inf
        for p in range(parts):
            for a in range(3):
                boxes[node, a, p] = part_lo[p, a]
                boxes[node, 3 + a, p] = part_hi[p, a]
            if stops[p] - starts[p] == 1:
                children[node, p] = -1 - starts[p]
            else:
                children[node, p] = nodes
                todo_node[todo], todo_start[todo], todo_stop[todo] = nodes, starts[p], stops[p]
                todo_level[todo] = level + 1
                todo += 1
                nodes += 1
    return order, boxes[:nodes].copy(), children[:nodes].copy()
