"""Kernel for the alpha of Gaussians at points. Arrays are checked and contiguous; scene frame."""

from __future__ import annotations

import numpy as np

from gsvis._kernels.compiled import kernel


@kernel
def largest_alpha(means, whitening, opacities, points, out):
    """Write the largest alpha at each point over the given Gaussians into out (P,); `whitening` is (K, 3, 3)."""
    for p in range(len(points)):
        best = 0.0
        for i in range(len(means)):
            squared = 0.0
            for row in range(3):
                along = 0.0
                for k in range(3):
                    along += whitening[i, row, k] * (points[p, k] - means[i, k])
                squared += along * along
            best = max(best, opacities[i] * np.exp(-0.5 * squared))
        out[p] = best
