"""Evaluate spherical harmonics and their colors in plain torch: any float type, any device, with gradients.

Directions run from the eye to the Gaussian, scene frame. The twin of `gsvis.scene.sh` and of the kernels behind
`gsvis.color.sh_colors`, written from its own formulas, so that tests can compare the two.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from gsvis import _check
from gsvis.scene.sh import sh_degree_of

__all__ = ["sh_basis_torch", "sh_colors_torch"]


def sh_basis_torch(directions: Tensor, degree: int) -> Tensor:
    """Return (D, (degree + 1)^2) real spherical harmonics of (D, 3) unit vectors; torch twin of `sh_basis`."""
    x, y, z = directions.unbind(-1)
    pi = math.pi
    columns = [torch.full_like(x, math.sqrt(1 / (4 * pi)))]
    if degree >= 1:
        c = math.sqrt(3 / (4 * pi))
        columns += [-c * y, c * z, -c * x]
    if degree >= 2:
        c = math.sqrt(15 / (4 * pi))
        c0 = math.sqrt(5 / (16 * pi))
        columns += [c * x * y, -c * y * z, c0 * (2 * z * z - x * x - y * y), -c * x * z, c / 2 * (x * x - y * y)]
    if degree >= 3:
        c3 = math.sqrt(35 / (32 * pi))
        c2 = math.sqrt(105 / (4 * pi))
        c1 = math.sqrt(21 / (32 * pi))
        c0 = math.sqrt(7 / (16 * pi))
        columns += [
            -c3 * y * (3 * x * x - y * y),
            c2 * x * y * z,
            -c1 * y * (4 * z * z - x * x - y * y),
            c0 * z * (2 * z * z - 3 * x * x - 3 * y * y),
            -c1 * x * (4 * z * z - x * x - y * y),
            c2 / 2 * z * (x * x - y * y),
            -c3 * x * (x * x - 3 * y * y),
        ]
    return torch.stack(columns, dim=-1)


def sh_colors_torch(
    means: Tensor,
    sh0: Tensor,
    shN: Tensor,  # noqa: N803  the field's own name
    eye: ArrayLike | Tensor,
    *,
    clipped: bool = True,
) -> Tensor:
    """Return the colors of all Gaussians from one eye. Checks shapes, not values.

    Args:
        means: (N, 3) centers, world frame.
        sh0: (N, 1, 3) constant coefficients.
        shN: (N, K-1, 3) higher coefficients, K in {1, 4, 9, 16}.
        eye: (3,) viewpoint, world frame; a tensor keeps its gradient.
        clipped: Clip below at 0; a clipped color has no gradient.

    Returns:
        (N, 3) RGB, of the dtype and device of `means`. A Gaussian centered at the eye is seen along +z.

    Raises:
        ValueError: If a shape is wrong, or an eye given as an array is not finite.
    """
    for name, value, shape in (("means", means, (3,)), ("sh0", sh0, (1, 3)), ("shN", shN, (None, 3))):
        fits = value.ndim == 1 + len(shape) and all(w in (None, h) for w, h in zip(shape, value.shape[1:], strict=True))
        if not fits or len(value) != len(means):
            spelled = ", ".join(str(s) if s is not None else "K-1" for s in (len(means), *shape))
            raise ValueError(f"{name}: expected shape ({spelled}), got {tuple(value.shape)}")
    if isinstance(eye, Tensor):
        if tuple(eye.shape) != (3,):
            raise ValueError(f"eye: expected shape (3,), got {tuple(eye.shape)}")
        viewpoint = eye.to(means)
    else:
        viewpoint = torch.tensor(_check.floats("eye", eye, (3,), np.float64)).to(means)
    offsets = means - viewpoint
    squared = offsets.square().sum(dim=1, keepdim=True)
    ahead = offsets.new_tensor([0.0, 0.0, 1.0])
    directions = torch.where(squared > 0, offsets / torch.where(squared > 0, squared, 1.0).sqrt(), ahead)
    basis = sh_basis_torch(directions, sh_degree_of(1 + shN.shape[1]))
    colors = 0.5 + (basis[:, :, None] * torch.cat([sh0, shN], dim=1)).sum(dim=1)
    return colors.clamp(min=0.0) if clipped else colors
