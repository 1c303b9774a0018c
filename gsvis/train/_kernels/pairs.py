"""Find which neighbors of a Gaussian are cheap to merge with it, and pair them greedily."""

from __future__ import annotations

import numpy as np

from gsvis._kernels.compiled import inner, kernel
from gsvis._kernels.threads import in_parts

_BLOCK = 1 << 10


@inner
def _log_det(xx, xy, xz, yy, yz, zz):
    """Return the logarithm of the determinant of a symmetric 3 x 3 matrix, with a floor."""
    found = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    return np.log(max(found, 1e-300))


@in_parts(lambda rows, *_: (len(rows) + _BLOCK - 1) // _BLOCK)
@kernel(error_model="numpy")
def price_neighbors(begin, end, rows, near, means, covars, weights, colors, color_weight, best, prices):
    """Write the cheapest neighbors of some Gaussians and their prices, ascending; -1 and inf where there is none.

    `rows` (R,) are the Gaussians, `near` (R, k) their neighbors, `covars` (N, 6) the upper triangles of covariances.
    The price of a pair is Runnalls' bound on the divergence of the merged Gaussian, plus `color_weight` times the
    squared difference of the colors.
    """
    kept = best.shape[1]
    for block in range(begin, end):
        for row in range(block * _BLOCK, min((block + 1) * _BLOCK, len(rows))):
            i = rows[row]
            best[i] = -1
            prices[i] = np.inf
            a = covars[i]
            own = _log_det(a[0], a[1], a[2], a[3], a[4], a[5])
            for j in near[row]:
                if j == i:
                    continue
                b = covars[j]
                share = weights[i] / (weights[i] + weights[j])
                rest = 1.0 - share
                x = means[i, 0] - means[j, 0]
                y = means[i, 1] - means[j, 1]
                z = means[i, 2] - means[j, 2]
                both = share * rest
                merged = _log_det(
                    share * a[0] + rest * b[0] + both * x * x,
                    share * a[1] + rest * b[1] + both * x * y,
                    share * a[2] + rest * b[2] + both * x * z,
                    share * a[3] + rest * b[3] + both * y * y,
                    share * a[4] + rest * b[4] + both * y * z,
                    share * a[5] + rest * b[5] + both * z * z,
                )
                price = 0.5 * (merged - share * own - rest * _log_det(b[0], b[1], b[2], b[3], b[4], b[5]))
                for c in range(3):
                    price += color_weight * (colors[i, c] - colors[j, c]) ** 2
                if not price < prices[i, kept - 1]:
                    continue
                place = kept - 1
                while place > 0 and price < prices[i, place - 1]:
                    prices[i, place] = prices[i, place - 1]
                    best[i, place] = best[i, place - 1]
                    place -= 1
                prices[i, place] = price
                best[i, place] = j


@kernel
def pair_up(order, best, most, groups):
    """Write the group of each Gaussian, by pairs in the order of their prices; return how many Gaussians less remain.

    `order` are flat indices of `best`; `groups` (N,) begins as -1 and stays so for a Gaussian that merges with none. At
    most `most` Gaussians go. What is left free joins a group of two, then of three, of a neighbor.
    """
    kept = best.shape[1]
    sizes = np.zeros(len(groups), np.int64)
    gone = 0
    found = 0
    for edge in order:
        if gone == most:
            return gone
        i = edge // kept
        j = best[i, edge % kept]
        if groups[i] < 0 and groups[j] < 0:
            groups[i] = found
            groups[j] = found
            sizes[found] = 2
            found += 1
            gone += 1
    for size in (2, 3):
        for edge in order:
            if gone == most:
                return gone
            i = edge // kept
            group = groups[best[i, edge % kept]]
            if groups[i] < 0 and group >= 0 and sizes[group] <= size:
                groups[i] = group
                sizes[group] += 1
                gone += 1
    return gone
