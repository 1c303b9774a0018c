"""Find the balls that rays may meet. World frame, scene units. Knows only balls and half-lines."""

from __future__ import annotations

from gsvis._kernels.compiled import kernel
from gsvis._kernels.threads import in_parts


@in_parts(lambda centers, *_: len(centers))
@kernel(error_model="numpy")
def mark_near(begin, end, centers, reaches, rays_o, rays_d, rounding, out):
    """Mark each ball (N,) whose distance from some ray (R, 3), unit directions, is at most its reach.

    `rounding` times the distance to the origin is added to the reach, for rays that another program rounds.
    """
    for g in range(begin, end):
        out[g] = False
        for r in range(len(rays_o)):
            x = centers[g, 0] - rays_o[r, 0]
            y = centers[g, 1] - rays_o[r, 1]
            z = centers[g, 2] - rays_o[r, 2]
            squared = x * x + y * y + z * z
            along = max(x * rays_d[r, 0] + y * rays_d[r, 1] + z * rays_d[r, 2], 0.0)
            reach = reaches[g] + rounding * squared**0.5
            if squared - along * along <= reach * reach:
                out[g] = True
                break
