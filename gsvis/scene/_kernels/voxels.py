"""Numba kernels of the scene room: splat Gaussians into a voxel grid, and follow rays through it.

They take checked, contiguous arrays, never raise and know no classes. `_occupancy.py` and `_evidence.py` prepare and
call them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis._kernels.compiled import kernel

__all__ = ["free_lengths", "splat_depth", "sum_beyond"]


@kernel
def splat_depth(
    depth: NDArray[np.float32],
    means: NDArray[np.float64],
    precisions: NDArray[np.float64],
    alphas: NDArray[np.float64],
    reach: float,
) -> Any:
    """Add -log(1 - alpha) of each Gaussian to every voxel it reaches.

    Args:
        depth: (X, Y, Z) optical depths, changed in place.
        means: (N, 3) centers in voxel units; voxel i has its center at i + 0.5.
        precisions: (N, 6) inverse covariances in voxel units: xx, xy, xz, yy, yz, zz.
        alphas: (N,) alpha at the center, < 1.
        reach: Standard deviations at which a Gaussian is cut off.
    """
    nx, ny, nz = depth.shape
    limit = reach * reach
    for i in range(len(means)):
        a, b, c, d, e, f = precisions[i]
        mx, my, mz = means[i]
        # The ellipsoid's extent in x, then in y for a given x, then in z for a given x and y, by Schur complements.
        d1 = d - e * e / f
        b1 = b - c * e / f
        a1 = a - c * c / f
        a2 = a1 - b1 * b1 / d1
        if not (a2 > 0.0 and d1 > 0.0 and f > 0.0):
            continue
        ex = np.sqrt(limit / a2)
        if not (mx + ex > 0.0 and mx - ex < nx):  # also keeps huge numbers away from the integers below
            continue
        x0 = int(max(0.0, np.ceil(mx - ex - 0.5)))
        x1 = int(min(nx - 1.0, np.floor(mx + ex - 0.5)))
        for x in range(x0, x1 + 1):
            dx = x + 0.5 - mx
            rest = limit - a2 * dx * dx
            if rest < 0.0:
                continue
            cy = my - b1 / d1 * dx
            ey = np.sqrt(rest / d1)
            if not (cy + ey > 0.0 and cy - ey < ny):
                continue
            y0 = int(max(0.0, np.ceil(cy - ey - 0.5)))
            y1 = int(min(ny - 1.0, np.floor(cy + ey - 0.5)))
            for y in range(y0, y1 + 1):
                dy = y + 0.5 - my
                lateral = a1 * dx * dx + 2.0 * b1 * dx * dy + d1 * dy * dy
                rest = limit - lateral
                if rest < 0.0:
                    continue
                cz = mz - (c * dx + e * dy) / f
                ez = np.sqrt(rest / f)
                if not (cz + ez > 0.0 and cz - ez < nz):
                    continue
                z0 = int(max(0.0, np.ceil(cz - ez - 0.5)))
                z1 = int(min(nz - 1.0, np.floor(cz + ez - 0.5)))
                for z in range(z0, z1 + 1):
                    dz = z + 0.5 - cz
                    depth[x, y, z] -= np.log(1.0 - alphas[i] * np.exp(-0.5 * (lateral + f * dz * dz)))


@kernel
def sum_beyond(depth: NDArray[np.float32], step: NDArray[np.int64], beyond: NDArray[np.float32]) -> Any:
    """Sum the optical depth beyond each voxel along a grid direction, up to the edge of the grid.

    Args:
        depth: (X, Y, Z) optical depths.
        step: (3,) the direction: -1, 0 or 1 along each axis, not all 0.
        beyond: (X, Y, Z) result.
    """
    nx, ny, nz = depth.shape
    sx, sy, sz = step
    # along z, where the next voxel lies on the grid
    first = max(-sz, 0)
    last = nz - max(sz, 0)
    for i in range(nx):
        x = nx - 1 - i if sx > 0 else i
        for j in range(ny):
            y = ny - 1 - j if sy > 0 else j
            ax = x + sx
            ay = y + sy
            if not (0 <= ax < nx and 0 <= ay < ny):
                for z in range(nz):
                    beyond[x, y, z] = 0.0
                continue
            if sx == 0 and sy == 0:
                beyond[x, y, nz - 1 if sz > 0 else 0] = 0.0
                for k in range(1, nz):
                    z = nz - 1 - k if sz > 0 else k
                    beyond[x, y, z] = depth[x, y, z + sz] + beyond[x, y, z + sz]
                continue
            for z in range(first, last):
                beyond[x, y, z] = depth[ax, ay, z + sz] + beyond[ax, ay, z + sz]
            if sz != 0:
                beyond[x, y, nz - 1 if sz > 0 else 0] = 0.0


@kernel
def free_lengths(
    depth: NDArray[np.float32],
    starts: NDArray[np.float64],
    directions: NDArray[np.float64],
    lengths: NDArray[np.float64],
    limit: float,
    found: NDArray[np.float64],
) -> Any:
    """Find how far rays go until the optical depth on them reaches `limit`.

    A step crosses one voxel along the ray's longest axis, as a sweep of the grid does. The voxel of the start does not
    count.

    Args:
        depth: (X, Y, Z) optical depths.
        starts: (R, 3) origins in voxel units; may lie outside of the grid.
        directions: (R, 3) unit vectors.
        lengths: (R,) voxels to go at most.
        limit: Optical depth at which a ray ends.
        found: (R,) result: voxels to the end of the ray; infinite if it is not stopped.
    """
    shape = depth.shape
    for r in range(len(starts)):
        longest = max(abs(directions[r, 0]), abs(directions[r, 1]), abs(directions[r, 2]))
        # in steps
        near = 0.0
        far = lengths[r] * longest
        for i in range(3):  # where the ray enters and leaves the grid
            step = directions[r, i] / longest
            at = starts[r, i]
            if step == 0.0:
                if not 0.0 <= at < shape[i]:
                    far = -1.0
                continue
            one = -at / step
            two = (shape[i] - at) / step
            near = max(near, min(one, two))
            far = min(far, max(one, two))
        t = max(np.ceil(near), 1.0)
        total = 0.0
        found[r] = np.inf
        while t <= far:
            x = int(np.floor(starts[r, 0] + t * directions[r, 0] / longest))
            y = int(np.floor(starts[r, 1] + t * directions[r, 1] / longest))
            z = int(np.floor(starts[r, 2] + t * directions[r, 2] / longest))
            if 0 <= x < shape[0] and 0 <= y < shape[1] and 0 <= z < shape[2]:
                total += depth[x, y, z]
                if total >= limit:
                    found[r] = t / longest
                    break
            t += 1.0
