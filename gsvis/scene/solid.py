"""Test where a scene is solid: eyes inside a Gaussian that hides what is behind it. Scene frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsvis.scene._kernels import alpha as kernels
from gsvis.scene.gaussians import Gaussians

__all__ = ["BURIED", "buried"]

F64 = NDArray[np.float64]

BURIED = 0.5
"""Alpha at the eye above which the eye counts as inside something solid."""


def buried(g: Gaussians, points: F64) -> NDArray[np.bool_]:
    """Return which points (P, 3) lie inside a Gaussian with an alpha of at least a half there."""
    solid = np.flatnonzero(g.opacities >= BURIED)
    if len(points) == 0 or len(solid) == 0:
        return np.zeros(len(points), bool)
    reach = np.sqrt(2.0 * np.log(g.opacities[solid].astype(np.float64) / BURIED)) * g.scales[solid].max(axis=1)
    means = g.means[solid]
    low, high = points.min(axis=0), points.max(axis=0)
    solid = solid[np.all((means + reach[:, None] >= low) & (means - reach[:, None] <= high), axis=1)]
    some = g[solid]
    whitening = np.swapaxes(some.rotations(), 1, 2) / some.scales.astype(np.float64)[:, :, None]
    alphas = np.zeros(len(points))
    kernels.largest_alpha(some.means, np.ascontiguousarray(whitening), some.opacities, points, alphas)
    return alphas >= BURIED
