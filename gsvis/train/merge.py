"""Merge many Gaussians into few: one per voxel of a grid, with the moments and the coverage of its Gaussians.

World frame, scene units. The coverage of a Gaussian is its opacity times the mean area of its shadows over all
directions. Nothing here renders.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsvis.jobs.in_order import in_order
from gsvis.scene.gaussians import Gaussians, quats_from_rotations

__all__ = ["mean_shadows", "merge_by_cell", "merge_gaussians", "occupied_voxels"]

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

_SIDE = 2**20  # voxels to either side of the middle; points beyond use the outermost voxel
_MOST_OPAQUE = 0.996  # the largest value of a byte
_PART = 1 << 16  # Gaussians merged at a time; bounds memory
_KNUD_THOMSEN = 1.6  # surface of an ellipsoid to about 1%


def merge_gaussians(g: Gaussians, count: int) -> Gaussians:
    """Merge a scene into `count` Gaussians: one for each occupied voxel of a grid.

    - The grid has its corner at the median of the centers. Its side is bisected until the occupied voxels are at least
      `count` and at most 1% more, or for 60 steps. The surplus voxels with the least coverage are dropped.
    - The weight of a Gaussian is its coverage w: its opacity times the mean area of its shadows, a quarter of its
    surface.
    - A merged Gaussian has the first two moments of its parts weighted by w (the mean, and the covariances plus the
      scatter of the means), and the mean of their SH coefficients.
    - Its opacity keeps the coverage: the sum of w over its own mean shadow, at most 0.996. A voxel with one Gaussian
      returns that Gaussian unchanged.

    Args:
        g: N Gaussians.
        count: Size of the result, 1 to the number of different centers.

    Returns:
        `count` Gaussians, by descending coverage.

    Raises:
        ValueError: If no voxel size gives `count` voxels.

    References:
        Opacity from coverage as in Kerbl et al., "A hierarchical 3D Gaussian representation for real-time rendering of
        very large datasets", 2024, section 4.1.
    """
    cells = _cells_for(g, count)
    number = int(cells.max()) + 1
    coverage = np.bincount(cells, g.opacities * mean_shadows(g.scales.astype(np.float64)), minlength=number)
    kept = np.argsort(-coverage, kind="stable")[:count]
    place = np.full(number, -1)
    place[kept] = np.arange(count)
    inside = place[cells] >= 0
    return merge_by_cell(g[inside], place[cells[inside]])


def _cells_for(g: Gaussians, count: int) -> I64:
    """Return the voxel (N,) of each Gaussian, with at least `count` voxels and as few more as bisection finds."""
    if not 1 <= count <= len(g):
        raise ValueError(f"count: expected 1 to {len(g)}, got {count}")
    means = g.means.astype(np.float64)
    middle = np.median(means, axis=0)
    span = float(np.abs(means - middle).max()) or 1.0
    # of the side; many voxels at the low end
    low = np.log(span / _SIDE)
    high = np.log(4.0 * span)
    best = occupied_voxels(means - middle, float(np.exp(low)))
    if best.max() + 1 < count:
        raise ValueError(f"count: expected at most {best.max() + 1} of {len(g)} with centers this close, got {count}")
    for _ in range(60):
        side = 0.5 * (low + high)
        cells = occupied_voxels(means - middle, float(np.exp(side)))
        if cells.max() + 1 >= count:
            low = side
            best = cells
            if best.max() + 1 <= 1.01 * count:
                break
        else:
            high = side
    return best


def occupied_voxels(points: F64, side: float) -> I64:
    """Return the index (N,) of the occupied voxel of each of the (N, 3) points, for cubes of a side."""
    steps = np.clip(np.floor(points / side), -_SIDE, _SIDE - 1).astype(np.int64) + _SIDE
    keys = (steps[:, 0] << 42) | (steps[:, 1] << 21) | steps[:, 2]
    return np.asarray(np.unique(keys, return_inverse=True)[1], np.int64).reshape(-1)


def merge_by_cell(g: Gaussians, cells: I64) -> Gaussians:
    """Merge the Gaussians of each cell into one, by the rules of `merge_gaussians`.

    Args:
        g: N Gaussians.
        cells: (N,) the cell of each, 0 to M - 1; no cell is empty.

    Returns:
        M Gaussians, in the order of the cells.
    """
    number = int(cells.max()) + 1
    order = np.argsort(cells, kind="stable")
    ends = np.append(np.searchsorted(cells[order], np.arange(number)), len(order))
    middle = np.median(g.means, axis=0).astype(np.float64)
    parts: list[slice] = []
    first = 0
    while first < number:
        last = max(first + 1, int(np.searchsorted(ends, ends[first] + _PART, side="right")) - 1)
        parts.append(slice(first, last))
        first = last

    def merge(part: slice) -> Gaussians:
        """Merge the Gaussians of some cells."""
        start = ends[part.start]
        return _merge_runs(g[order[start : ends[part.stop]]], ends[part] - start, middle)

    return Gaussians.concatenate(list(in_order(merge, parts)))


def _merge_runs(g: Gaussians, starts: I64, middle: F64) -> Gaussians:
    """Merge each run of neighboring rows into one; `starts` (M,) has the first row of each, `middle` (3,) an origin."""
    number = len(starts)
    lengths = np.diff(np.append(starts, len(g)))
    shadows = mean_shadows(g.scales.astype(np.float64))
    weights = np.maximum(g.opacities * shadows, 1e-30)  # cells of invisible Gaussians need a mean too
    total = np.add.reduceat(weights, starts)

    def mean(values: NDArray[np.floating]) -> F64:
        """Return the weighted mean of values in each run."""
        weighted = values.reshape(len(values), -1) * weights[:, None]
        sums = np.add.reduceat(weighted, starts, axis=0) / total[:, None]
        return sums.reshape(number, *values.shape[1:])

    means = mean(g.means - middle)
    away = (g.means - middle) - np.repeat(means, lengths, axis=0)
    covars = mean(g.covars() + away[:, :, None] * away[:, None, :])
    squares, axes = np.linalg.eigh(covars)
    scales = np.sqrt(np.maximum(squares, np.maximum(1e-12 * squares[:, 2:], 1e-18)))
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
    visible = np.add.reduceat(g.opacities * shadows, starts)
    alone = lengths == 1
    merged = {
        "means": means + middle,
        "quats": quats_from_rotations(axes),
        "scales": scales,
        "opacities": np.minimum(visible / mean_shadows(scales), _MOST_OPAQUE),
        "sh0": mean(g.sh0),
        "shN": mean(g.shN) if g.sh_degree else np.zeros((number, 0, 3)),
    }
    same = starts[alone]
    for name, values in merged.items():
        values[alone] = getattr(g, name)[same]
    return Gaussians(**merged, facts=g.facts)


def mean_shadows(scales: F64) -> F64:
    """Return (N,) mean areas of the shadows of ellipsoids with these half axes: a quarter of their surface."""
    a, b, c = (scales**_KNUD_THOMSEN).T
    return np.asarray(np.pi * ((a * b + b * c + c * a) / 3.0) ** (1.0 / _KNUD_THOMSEN))
