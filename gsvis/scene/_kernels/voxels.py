"""Numba kernels of the scene room: splat Gaussians into a voxel grid.

They take checked, contiguous arrays, never raise and know no classes. `navigable.py` prepares and calls them.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

__all__ = ["splat_depth"]


@numba.njit(cache=True, nogil=True)
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
        d1, b1 = d - e * e / f, b - c * e / f
        a1 = a - c * c / f
        a2 = a1 - b1 * b1 / d1
        if not (a2 > 0.0 and d1 > 0.0 and f > 0.0):
            continue
        ex = np.sqrt(limit / a2)
        if not (mx + ex > 0.0 and mx - ex < nx):  # also keeps huge numbers away from the integers below
            continue
        x0, x1 = int(max(0.0, np.ceil(mx - ex - 0.5))), int(min(nx - 1.0, np.floor(mx + ex - 0.5)))
        for x in range(x0, x1 + 1):
            dx = x + 0.5 - mx
            rest = limit - a2 * dx * dx
            if rest < 0.0:
                continue
            cy, ey = my - b1 / d1 * dx, np.sqrt(rest / d1)
            if not (cy + ey > 0.0 and cy - ey < ny):
                continue
            y0, y1 = int(max(0.0, np.ceil(cy - ey - 0.5))), int(min(ny - 1.0, np.floor(cy + ey - 0.5)))
            for y in range(y0, y1 + 1):
                dy = y + 0.5 - my
                lateral = a1 * dx * dx + 2.0 * b1 * dx * dy + d1 * dy * dy
                rest = limit - lateral
                if rest < 0.0:
                    continue
                cz, ez = mz - (c * dx + e * dy) / f, np.sqrt(rest / f)
                if not (cz + ez > 0.0 and cz - ez < nz):
                    continue
                z0, z1 = int(max(0.0, np.ceil(cz - ez - 0.5))), int(min(nz - 1.0, np.floor(cz + ez - 0.5)))
                for z in range(z0, z1 + 1):
                    dz = z + 0.5 - cz
                    depth[x, y, z] -= np.log(1.0 - alphas[i] * np.exp(-0.5 * (lateral + f * dz * dz)))
