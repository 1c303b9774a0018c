"""A machine with a GPU, pretended: tensors lie on the CPU, and a gsplat of plain torch draws them.

It takes what gsplat's `rasterization` takes, refuses the shapes that it refuses, and returns the same, so that the
backend "cuda" runs whole where there is no GPU.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from gsvis.render import device
from gsvis.render.reference_torch import blend_reference, project_reference
from gsvis.render.tensors import GaussianTensors

__all__ = ["pretend_gpu"]


def pretend_gpu(patch: pytest.MonkeyPatch) -> None:
    """Make torch, gsplat and the backend "cuda" work without a GPU, until the patch is undone."""
    patch.setitem(sys.modules, "gsplat", SimpleNamespace(rasterization=rasterization))
    patch.setattr(device, "has", lambda package: True)
    patch.setitem(device._TORCH_DEVICES, "cuda", "cpu")
    patch.setattr(torch.version, "cuda", "12.6")
    patch.setattr(torch.cuda, "is_available", lambda: True)
    patch.setattr(torch.cuda, "synchronize", lambda: None)
    patch.setattr(torch.cuda, "get_device_name", lambda: "a pretended GPU")


def rasterization(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    *,
    near_plane: float,
    eps2d: float,
    sh_degree: int | None,
    packed: bool,
    backgrounds: Tensor,
    render_mode: str,
    rasterize_mode: str,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Draw one camera as gsplat does: images and depths (1, H, W, 4), alphas (1, H, W, 1), and what lies between."""
    count = len(means)
    assert count
    assert (quats.shape, scales.shape, opacities.shape) == ((count, 4), (count, 3), (count,))
    assert (viewmats.shape, Ks.shape, backgrounds.shape) == ((1, 4, 4), (1, 3, 3), (1, 3))
    assert {each.dtype for each in (means, quats, scales, opacities, colors, viewmats, Ks)} == {torch.float32}
    assert (eps2d, packed, render_mode) == (0.3, False, "RGB+ED")
    assert near_plane > 0
    if sh_degree is None:
        assert colors.shape == (count, 3)
    else:
        assert colors.shape[0] == count
        assert colors.shape[1] >= (sh_degree + 1) ** 2
    harmonics = torch.zeros(count, 1, 3) if sh_degree is None else colors
    tensors = GaussianTensors(means, quats, scales, opacities, harmonics[:, :1], harmonics[:, 1:])
    projection = project_reference(
        tensors,
        viewmats[0].numpy().astype(np.float64),
        Ks[0].numpy().astype(np.float64),
        width,
        height,
        sh_degree=sh_degree,
        antialiased=rasterize_mode == "antialiased",
        colors=colors if sh_degree is None else None,
    )
    means2d = projection.means2d[None]
    drawn = blend_reference(tensors, replace(projection, means2d=means2d[0]), width, height, backgrounds[0].numpy())
    images = torch.cat([drawn.image, drawn.depth[..., None]], dim=2)[None]
    return images, drawn.alpha[None, ..., None], {"means2d": means2d}
