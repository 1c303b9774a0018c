"""The slow twin of `removal_effects`: it composites every pixel without each Gaussian in turn, in float64.

It never stops at low transmittance; everything else is the same as in the reference rasterizer.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis.render.reference import composite, pixel_centers, project_reference
from gsvis.render.removal import RemovalEffects
from gsvis.render.splats import View
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians

__all__ = ["removal_reference"]


def removal_reference(
    gaussians: Gaussians,
    cameras: Cameras,
    *,
    residuals: NDArray[np.float64] | None = None,
    background: ArrayLike = (0.0, 0.0, 0.0),
) -> RemovalEffects:
    """Return the effect of removing each Gaussian on images, by removing each in turn.

    Args:
        gaussians: N Gaussians.
        cameras: C cameras.
        residuals: (C, H, W, 3) image minus target; None for zeros.
        background: (3,) RGB behind everything.
    """
    behind = np.asarray(background, np.float64)
    sums = np.zeros((3, len(gaussians)))
    for c in range(len(cameras)):
        view = View.from_matrices(cameras.viewmats[c], cameras.Ks[c], cameras.width, cameras.height)
        splats = project_reference(gaussians, view)
        alphas = splats.alphas(pixel_centers(view))
        full = composite(alphas, splats.colors, behind)[0]
        residual = np.zeros_like(full) if residuals is None else residuals[c].reshape(-1, 3)
        for k in np.flatnonzero(alphas.any(axis=0)):
            without = alphas.copy()
            without[:, k] = 0.0
            change = composite(without, splats.colors, behind)[0] - full
            by_error = np.square(change + residual) - np.square(residual)
            sums[:, splats.ids[k]] += [v.sum() / 3.0 for v in (np.abs(change), np.square(change), by_error)]
    absolute, squared, error_change = sums
    return RemovalEffects(absolute, squared, error_change, len(cameras) * cameras.width * cameras.height)
