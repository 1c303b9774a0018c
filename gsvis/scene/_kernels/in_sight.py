"""Numba kernels of the scene room: mark the voxels that rays cross before they are stopped, and what lies near them.

They take checked, contiguous arrays, never raise and know no classes. `in_sight.py` prepares and calls them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis._kernels.compiled import kernel
from gsvis._kernels.threads import in_parts

__all__ = ["mark_crossed", "mark_seen"]

_STEP = 0.7  # voxels


@kernel
def mark_crossed(
    occupied: NDArray[np.bool_],
    start: NDArray[np.float64],
    directions: NDArray[np.float64],
    walls: int,
    crossed: NDArray[np.bool_],
) -> Any:
    """Mark the voxels on rays from one point, up to and including the last occupied step that a ray is allowed.

    Args:
        occupied: (X, Y, Z) voxels that stop light.
        start: (3,) origin in voxel units; may lie outside of the grid.
        directions: (R, 3) unit vectors.
        walls: Number of steps in occupied voxels after which a ray ends.
        crossed: (X, Y, Z) result; voxels on a ray become True.
    """
    shape = occupied.shape
    for r in range(len(directions)):
        # where the ray enters and leaves the grid
        near = 0.0
        far = np.inf
        for i in range(3):
            step = directions[r, i]
            at = start[i]
            if step == 0.0:
                if not 0.0 <= at < shape[i]:
                    far = -1.0
                continue
            one = -at / step
            two = (shape[i] - at) / step
            near = max(near, min(one, two))
            far = min(far, max(one, two))
        t = near + 1e-6
        met = 0
        while t < far and met < walls:
            x = int(np.floor(start[0] + t * directions[r, 0]))
            y = int(np.floor(start[1] + t * directions[r, 1]))
            z = int(np.floor(start[2] + t * directions[r, 2]))
            if 0 <= x < shape[0] and 0 <= y < shape[1] and 0 <= z < shape[2]:
                crossed[x, y, z] = True
                if occupied[x, y, z]:
                    met += 1
            t += _STEP


@in_parts(lambda voxels, *_: len(voxels))
@kernel
def mark_seen(first, last, voxels, reaches, near, seen):
    """Mark the Gaussians of a range of rows that may be in sight.

    Args:
        first: First row of the range.
        last: Row after the last one.
        voxels: (N,) int32 or int64 flat index of the voxel of each; negative for those always in sight.
        reaches: (N,) int8 index of the reach of each, at most 7.
        near: (V,) uint8; bit r of a voxel is set if it lies within reach r of a voxel in sight.
        seen: (N,) bool result.
    """
    for k in range(first, last):
        voxel = voxels[k]
        seen[k] = voxel < 0 or (near[voxel] >> reaches[k]) & 1 != 0
