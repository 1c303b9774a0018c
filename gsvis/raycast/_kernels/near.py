"""Find the balls and ellipsoids that rays may meet. World frame, scene units. Knows only these and half-lines."""

from __future__ import annotations

import numpy as np

from gsvis._kernels.compiled import inner, kernel
from gsvis._kernels.threads import in_parts

_BLOCK = 64
_SLACK = 1e-9  # of squared distances, for rounding


@inner(error_model="numpy")
def _is_near(center, reach, rays_o, rays_d, r, slack):
    """Return whether a ball around (3,) may meet a ray; `slack` is a share of its squared distance to the origin."""
    x = center[0] - rays_o[r, 0]
    y = center[1] - rays_o[r, 1]
    z = center[2] - rays_o[r, 2]
    squared = x * x + y * y + z * z
    along = max(x * rays_d[r, 0] + y * rays_d[r, 1] + z * rays_d[r, 2], 0.0)
    return squared - along * along <= reach * reach + slack * squared


@inner(error_model="numpy")
def _is_met(center, whitening, rays_o, rays_d, r):
    """Return whether a ray meets an ellipsoid around (3,), which `whitening` (3, 3) maps to the unit ball."""
    start = np.empty(3)
    way = np.empty(3)
    along = 0.0
    squared = 0.0
    length = 0.0
    for i in range(3):
        start[i] = 0.0
        way[i] = 0.0
        for j in range(3):
            start[i] += whitening[i, j] * (rays_o[r, j] - center[j])
            way[i] += whitening[i, j] * rays_d[r, j]
        along += start[i] * way[i]
        squared += start[i] * start[i]
        length += way[i] * way[i]
    if along >= 0.0:
        return squared <= 1.0
    x = start[1] * way[2] - start[2] * way[1]
    y = start[2] * way[0] - start[0] * way[2]
    z = start[0] * way[1] - start[1] * way[0]
    return x * x + y * y + z * z <= length


@inner(error_model="numpy")
def _bound(centers, reaches, first, end, middle):
    """Write the middle of some balls and return the radius of a ball around it that holds them."""
    for i in range(3):
        low = centers[first, i]
        high = low
        for g in range(first, end):
            low = min(low, centers[g, i])
            high = max(high, centers[g, i])
        middle[i] = 0.5 * (low + high)
    radius = 0.0
    for g in range(first, end):
        squared = 0.0
        for i in range(3):
            squared += (centers[g, i] - middle[i]) ** 2
        radius = max(radius, squared**0.5 + reaches[g])
    return radius


@in_parts(lambda centers, *_: (len(centers) + _BLOCK - 1) // _BLOCK)
@kernel(error_model="numpy")
def mark_near(begin, end, centers, reaches, shapes, rays_o, rays_d, rounding, out):
    """Mark each ball (N,) whose distance from some ray (R, 3), unit directions, is at most its reach.

    `rounding` times the distance to the origin is added to the reach, for rays that another program rounds. Rays that
    are far from a ball around 64 balls in a row are tested no further. With `shapes` (N, 3, 3), which map ellipsoids
    in these balls to the unit ball, the ray must meet the ellipsoid too; (0, 3, 3) for balls alone.
    """
    middle = np.empty(3)
    near = np.empty(len(rays_o), np.int64)
    for block in range(begin, end):
        first = _BLOCK * block
        last = min(first + _BLOCK, len(centers))
        radius = _bound(centers, reaches, first, last, middle)
        count = 0
        for r in range(len(rays_o)):
            away = 0.0
            for i in range(3):
                away += (middle[i] - rays_o[r, i]) ** 2
            reach = radius + rounding * (away**0.5 + radius)
            if _is_near(middle, reach, rays_o, rays_d, r, _SLACK):
                near[count] = r
                count += 1
        for g in range(first, last):
            out[g] = False
            for k in range(count):
                r = near[k]
                away = 0.0
                for i in range(3):
                    away += (centers[g, i] - rays_o[r, i]) ** 2
                if not _is_near(centers[g], reaches[g] + rounding * away**0.5, rays_o, rays_d, r, 0.0):
                    continue
                if len(shapes) == 0 or _is_met(centers[g], shapes[g], rays_o, rays_d, r):
                    out[g] = True
                    break
