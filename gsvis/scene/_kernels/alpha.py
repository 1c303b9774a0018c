"""Find points inside opaque Gaussians. Arrays are checked and contiguous; scene frame.

Points lie in bins: `bins` is the lowest corner (3,) of a cube of `side` bins along each axis, bins per unit (3,), and
(side**3 + 1,) where the points of each bin begin, the last axis fastest. Points are in the order of their bins.
"""

from __future__ import annotations

import math

import numpy as np

from gsvis._kernels.compiled import inner, kernel
from gsvis._kernels.threads import in_parts


@inner
def _bin(at, origin, per_unit, side):
    """Return the bin of a coordinate, clamped to the cube; monotonic in the coordinate."""
    return int(min(max((at - origin) * per_unit, 0.0), side - 1.0))


@inner
def _span(low, high, i, origin, per_unit, side, first, last):
    """Write the first and the last bin of a box along each axis."""
    for axis in range(3):
        first[axis] = _bin(low[i, axis], origin[axis], per_unit[axis], side)
        last[axis] = _bin(high[i, axis], origin[axis], per_unit[axis], side)


@kernel
def bin_points(points, origin, per_unit, side, out):
    """Write the bin of each point (P, 3) into out (P,)."""
    for p in range(len(points)):
        number = 0
        for axis in range(3):
            number = number * side + _bin(points[p, axis], origin[axis], per_unit[axis], side)
        out[p] = number


@inner
def _holds(low, high, i, points, p):
    """Return whether a box holds a point. Takes indices, because making row views would cost more than the test."""
    return (
        low[i, 0] <= points[p, 0] <= high[i, 0]
        and low[i, 1] <= points[p, 1] <= high[i, 1]
        and low[i, 2] <= points[p, 2] <= high[i, 2]
    )


@in_parts(lambda low, *_: len(low))
@kernel
def find_holding(begin, end, low, high, points, bins, side, out):
    """Write into out (K,) which of the boxes (K, 3) hold a point."""
    origin, per_unit, starts = bins
    first = np.empty(3, np.int64)
    last = np.empty(3, np.int64)
    for i in range(begin, end):
        _span(low, high, i, origin, per_unit, side, first, last)
        found = False
        for x in range(first[0], last[0] + 1):
            for y in range(first[1], last[1] + 1):
                row = (x * side + y) * side
                for p in range(starts[row + first[2]], starts[row + last[2] + 1]):
                    if _holds(low, high, i, points, p):
                        found = True
                        break
                if found:
                    break
            if found:
                break
        out[i] = found


@in_parts(lambda low, high, points, runs_low, *_: len(runs_low))
@kernel
def find_holding_in_runs(begin, end, low, high, points, runs_low, runs_high, length, out):
    """Do what `find_holding` does for few points (P, 3): only in runs of boxes (B, 3) that hold one. `out` is False."""
    for run in range(begin, end):
        first = run * length
        last = min(first + length, len(low))
        for p in range(len(points)):
            if not _holds(runs_low, runs_high, run, points, p):
                continue
            for i in range(first, last):
                out[i] |= _holds(low, high, i, points, p)


@kernel
def find_buried(shapes, low, high, points, bins, side, least, out):
    """Write into out (P,) which points have an alpha of `least` or more in a Gaussian whose box holds them.

    `shapes` is means (K, 3), whitening (K, 3, 3) and opacities (K,).
    """
    means, whitening, opacities = shapes
    origin, per_unit, starts = bins
    first = np.empty(3, np.int64)
    last = np.empty(3, np.int64)
    for i in range(len(means)):
        _span(low, high, i, origin, per_unit, side, first, last)
        for x in range(first[0], last[0] + 1):
            for y in range(first[1], last[1] + 1):
                row = (x * side + y) * side
                for p in range(starts[row + first[2]], starts[row + last[2] + 1]):
                    if out[p] or not _holds(low, high, i, points, p):
                        continue
                    squared = 0.0
                    for line in range(3):
                        along = 0.0
                        for k in range(3):
                            along += whitening[i, line, k] * (points[p, k] - means[i, k])
                        squared += along * along
                    out[p] = opacities[i] * math.exp(-0.5 * squared) >= least
