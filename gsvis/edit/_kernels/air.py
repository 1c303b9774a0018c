"""Find air, the voxels that light from eyes reaches, and the share of each Gaussian in it.

Arrays are checked and contiguous; positions are in voxels.
"""

from __future__ import annotations

import numpy as np

from gsvis._kernels.compiled import kernel
from gsvis._kernels.threads import in_parts


@kernel
def mark_passed(depth, starts, directions, limit, passed):
    """Set passed (X, Y, Z) for voxels that rays from starts (E, 3) along directions (D, 3) reach, all pairs.

    A ray ends behind the voxel in which its optical depth reaches `limit`. A step crosses one voxel along the longest
    axis of the ray. The voxel of the start absorbs no light.
    """
    nx, ny, nz = depth.shape
    for e in range(len(starts)):
        for d in range(len(directions)):
            dx = directions[d, 0]
            dy = directions[d, 1]
            dz = directions[d, 2]
            longest = max(abs(dx), abs(dy), abs(dz))
            dx = dx / longest
            dy = dy / longest
            dz = dz / longest
            x = starts[e, 0]
            y = starts[e, 1]
            z = starts[e, 2]
            total = 0.0
            first = True
            while True:
                i = int(np.floor(x))
                j = int(np.floor(y))
                k = int(np.floor(z))
                if not (0 <= i < nx and 0 <= j < ny and 0 <= k < nz):
                    break
                passed[i, j, k] = True
                if not first:
                    total += depth[i, j, k]
                    if total >= limit:
                        break
                first = False
                x = x + dx
                y = y + dy
                z = z + dz


@in_parts(lambda means, *_: len(means))
@kernel(error_model="numpy")
def count_places(begin, end, means, axes, points, labels, counts):
    """Count the sample points of each Gaussian in each kind of voxels.

    Args:
        begin: First of the thread's part; the caller leaves it out.
        end: After the last of the part; the caller leaves it out.
        means: (N, 3) centers in voxels.
        axes: (N, 3, 3) principal axes as columns, one standard deviation long, in voxels.
        points: (P, 3) samples of a normal distribution.
        labels: (X, Y, Z) uint8, kind of each voxel, 0 to 2.
        counts: (N, 3) result, number of points in voxels of each kind; points outside the grid count as kind 0.
    """
    nx, ny, nz = labels.shape
    for n in range(begin, end):
        for kind in range(3):
            counts[n, kind] = 0
        for p in range(len(points)):
            x = means[n, 0]
            y = means[n, 1]
            z = means[n, 2]
            for a in range(3):
                x += axes[n, 0, a] * points[p, a]
                y += axes[n, 1, a] * points[p, a]
                z += axes[n, 2, a] * points[p, a]
            kind = 0
            if 0.0 <= x < nx and 0.0 <= y < ny and 0.0 <= z < nz:
                kind = labels[int(x), int(y), int(z)]
            counts[n, kind] += 1
