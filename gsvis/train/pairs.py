"""Merge many Gaussians into few, pair by pair: those first whose merged Gaussian looks most like the two.

Voxels mix what lies near; pairs are chosen by shape and color too, so that a merged Gaussian stays on its surface.
World frame, scene units; the result does not depend on the unit. Nothing here renders.
"""

from __future__ import annotations

import numpy as np
from numba import get_num_threads
from numpy.typing import NDArray

from gsvis._sorting import stable_order
from gsvis.jobs.in_order import in_order
from gsvis.scene.gaussians import Gaussians, rotations_from_quats
from gsvis.scene.morton import morton_order
from gsvis.train._kernels.pairs import pair_up, price_neighbors
from gsvis.train.merge import mean_shadows, merge_by_cell

__all__ = ["merge_pairs", "merge_pairs_grouped"]

_NEAR = 16  # neighbors of a Gaussian that it may merge with
_CANDIDATES = 4  # of these, the cheapest
_FLOOR = 0.05  # least scale that counts, over the geometric mean of the two others
_COLOR = 0.1  # price of a squared difference of 1 in a coefficient of SH degree 0
_UPPER = [0, 1, 2, 4, 5, 8]  # entries of a 3 x 3 matrix, flat
_ROWS = 1 << 17  # Gaussians whose neighbors are in memory at a time
_LEAST = 0.05  # share of the Gaussians that a turn must remove


def merge_pairs(g: Gaussians, count: int) -> Gaussians:
    """Merge a scene into `count` Gaussians, by turns that pair neighbors, cheap pairs first.

    The price of a pair is Runnalls' bound on the divergence of the two from the Gaussian with their moments, plus the
    squared difference of their colors. A turn removes at most half of what is left. Merged Gaussians follow
    `merge_by_cell`, so mean, covariance and coverage of each group are kept.

    Args:
        g: N Gaussians.
        count: Size of the result, 1 to N.

    Returns:
        `count` Gaussians.

    References:
        Runnalls, "Kullback-Leibler approach to Gaussian mixture reduction", 2007, equation 21. The turns, and the
        groups of up to four, are those of `splat-transform --decimate`.
    """
    return merge_pairs_grouped(g, count)[0]


def merge_pairs_grouped(g: Gaussians, count: int) -> tuple[Gaussians, NDArray[np.int64]]:
    """Return what `merge_pairs` returns, and which of them each of the N Gaussians became (N,)."""
    if not 1 <= count <= len(g):
        raise ValueError(f"count: expected 1 to {len(g)}, got {count}")
    became = np.arange(len(g))
    while len(g) > count:
        groups = _group(g, len(g) - count)
        g = merge_by_cell(g, groups)
        became = groups[became]
    return g, became


def _group(g: Gaussians, most: int) -> NDArray[np.int64]:
    """Return the group (N,) of each Gaussian after one turn that removes at most `most`."""
    n = len(g)
    best, prices = _price_pairs(g)
    flat = prices.reshape(-1)
    order = stable_order(flat)
    order = order[: int(np.isfinite(flat).sum())]
    groups = np.full(n, -1, np.int64)
    gone = pair_up(order, best, min(most, n // 2), groups)
    if gone < min(most, _LEAST * n):  # neighbors in circles of equal centers: pair them in order
        groups[:] = -1
        groups[: 2 * min(most, n // 2)] = np.arange(2 * min(most, n // 2)) // 2
    alone = groups < 0
    groups[alone] = groups.max(initial=-1) + 1 + np.arange(int(alone.sum()))
    return groups


def _price_pairs(g: Gaussians) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the cheapest neighbors (N, 4) of each Gaussian and their prices, as `price_neighbors` writes them."""
    from scipy.spatial import cKDTree  # slow to import

    n = len(g)
    best = np.empty((n, _CANDIDATES), np.int64)
    prices = np.empty((n, _CANDIDATES))
    means = np.ascontiguousarray(g.means, np.float64)
    colors = np.ascontiguousarray(g.sh0[:, 0], np.float64)
    weights = np.maximum(g.opacities * mean_shadows(g.scales.astype(np.float64)), 1e-300)
    covars = _thick(g)
    order = morton_order(g.means)  # neighbors lie close in memory
    tree = cKDTree(means[order])
    for first in range(0, n, _ROWS):
        rows = order[first : first + _ROWS]
        found = tree.query(means[rows], k=min(_NEAR + 1, n), workers=get_num_threads())[1].reshape(len(rows), -1)
        near = order[np.minimum(found, n - 1)]
        price_neighbors(rows, near, means, covars, weights, colors, _COLOR, best, prices)
    return best, prices


def _thick(g: Gaussians) -> NDArray[np.float64]:
    """Return upper triangles (N, 6) of covariances; a flat Gaussian counts as a little thick."""
    covars = np.empty((len(g), len(_UPPER)))

    def write(some: slice) -> None:
        """Write the covariances of some Gaussians."""
        scales = np.sort(g.scales[some].astype(np.float64), axis=1)
        least = _FLOOR * np.sqrt(scales[:, 1] * scales[:, 2])
        half = rotations_from_quats(g.quats[some]) * g.scales[some].astype(np.float64)[:, None, :]
        thick = half @ np.swapaxes(half, 1, 2) + (least**2)[:, None, None] * np.eye(3)
        covars[some] = thick.reshape(-1, 9)[:, _UPPER]

    for _ in in_order(write, [slice(k, k + _ROWS) for k in range(0, len(g), _ROWS)]):
        pass
    return covars
