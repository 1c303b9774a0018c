"""The slow twin of `removal_effects`: every pixel composited again without each Gaussian in turn, in float64.

It never stops at spent transmittance; everything else is the reference rasterizer's.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from gsvis.render.reference import _alphas, _front_to_back, _pixel_centers, project_reference
from gsvis.render.removal import RemovalEffects
from gsvis.render.tensors import GaussianTensors
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
    """What removing each Gaussian does to images, by doing it.

    Args:
        gaussians: N Gaussians.
        cameras: C cameras.
        residuals: (C, H, W, 3) image minus target; None for zeros.
        background: (3,) RGB behind everything.
    """
    tensors = GaussianTensors.from_gaussians(gaussians, torch.float64)
    behind = torch.tensor(np.asarray(background, np.float64))
    sums = torch.zeros((3, len(gaussians)), dtype=torch.float64)
    for c in range(len(cameras)):
        size = cameras.width, cameras.height
        projection = project_reference(tensors, cameras.viewmats[c], cameras.Ks[c], *size)
        order = _front_to_back(tensors, projection)
        alphas = _alphas(projection, order, _pixel_centers(*size, projection.means2d))
        full = _composite(alphas, projection.colors[order], behind)
        residual = torch.zeros_like(full) if residuals is None else torch.tensor(residuals[c].reshape(-1, 3))
        for k in alphas.any(dim=0).nonzero()[:, 0].tolist():
            without = alphas.clone()
            without[:, k] = 0.0
            change = _composite(without, projection.colors[order], behind) - full
            by_error = (change + residual).square() - residual.square()
            sums[:, order[k]] += torch.stack([v.sum() for v in (change.abs(), change.square(), by_error)]) / 3.0
    absolute, squared, error_change = sums.numpy()
    return RemovalEffects(absolute, squared, error_change, len(cameras) * cameras.width * cameras.height)


def _composite(alphas: torch.Tensor, colors: torch.Tensor, background: torch.Tensor) -> torch.Tensor:
    """(P, 3) of (P, M) alphas, front to back."""
    after = torch.cumprod(1.0 - alphas, dim=1)
    before = torch.cat([after.new_ones(len(after), 1), after], dim=1)
    return torch.addmm(before[:, -1:] * background, alphas * before[:, :-1], colors)
