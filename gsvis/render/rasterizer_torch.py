"""Render images of Gaussians that are tensors, with gradients, and with gsplat's kernels on a GPU.

Conventions: docs/conventions.md, OpenCV cameras, pixel centers at +0.5, colors not clipped above. The backends differ
mainly in speed: `cpu` (numba, float32), `reference` (plain torch, any float type, slow), `cuda` (gsplat, no median
depth).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsvis.errors import BackendError
from gsvis.render.colors import Colors
from gsvis.render.colors_torch import TensorColors, camera_colors_torch
from gsvis.render.cpu import Frozen, rasterize_cpu
from gsvis.render.cuda import rasterize_cuda
from gsvis.render.device import why_no_cuda
from gsvis.render.reference_torch import blend_reference, project_reference
from gsvis.render.splats import View
from gsvis.render.tensors import GaussianTensors
from gsvis.scene.cameras import Cameras

__all__ = ["RenderingTensors", "rasterize_tensors"]


@dataclass(frozen=True, eq=False)
class RenderingTensors:
    """Images of C cameras, as torch tensors on the Gaussians' device; `Rendering` is the same as arrays.

    Attributes:
        images: (C, H, W, 3) RGB, 0 black, 1 white, brighter values kept.
        alphas: (C, H, W) in [0, 1], one minus the remaining transmittance.
        depths: (C, H, W) expected camera z, weighted by blending weights; 0 where nothing is seen.
        median_depths: (C, H, W) camera z of the first Gaussian behind which transmittance is at most 0.5; 0 if there is
            none; NaN with the backend `cuda`.
        means2d: (C, N, 2) zeros. After a backward pass `means2d.grad` is the gradient of the loss by the projected
            centers, per pixel, which densification needs.
    """

    images: Tensor
    alphas: Tensor
    depths: Tensor
    median_depths: Tensor
    means2d: Tensor


def rasterize_tensors(
    tensors: GaussianTensors,
    cameras: Cameras,
    *,
    backend: str,
    background: NDArray[np.float32],
    sh_degree: int,
    antialiased: bool,
    colors: Colors | TensorColors,
    frozen: int,
) -> RenderingTensors:
    """Render tensors; `gsvis.render.rasterize` documents and checks the arguments.

    Args:
        tensors: N Gaussians. Their values are checked only if no gradient is needed.
        cameras: C cameras of one size, without skew.
        backend: One of `gsvis.render.rasterizer.BACKENDS`.
        background: (3,) RGB.
        sh_degree: Degree to evaluate, at most that of the tensors.
        antialiased: Lower opacities so that the dilation keeps their integral.
        colors: Colors that replace SH; None for SH.
        frozen: Number of Gaussians, from the first on, that receive no gradient except through `means2d`.

    Raises:
        ValueError: If a color or a value does not fit.
        BackendError: If the backend cannot run here.
    """
    if backend == "auto":
        backend = "cuda" if tensors.means.is_cuda else "cpu"
    per_camera = camera_colors_torch(colors, tensors, cameras, backend)
    draw: _Draw = {"cpu": _draw_cpu, "cuda": _draw_cuda, "reference": _draw_reference}[backend]
    takes_gradient = torch.is_grad_enabled() and (
        per_camera.requires_grad or any(t.requires_grad for t in vars(tensors).values())
    )
    if not takes_gradient:
        tensors.check_values()
    if frozen and takes_gradient and backend != "cpu":
        parts = {name: torch.cat([t[:frozen].detach(), t[frozen:]]) for name, t in vars(tensors).items()}
        tensors = GaussianTensors(**parts)
    elif frozen and backend == "cpu":
        draw = partial(_draw_cpu, frozen=frozen)
    shape = (len(cameras), len(tensors), 2)
    means2d = torch.zeros(shape, dtype=tensors.means.dtype, device=tensors.means.device, requires_grad=takes_gradient)
    outputs = []
    for c in range(len(cameras)):
        outputs.append(draw(tensors, cameras[c], background, sh_degree, antialiased, per_camera.of(c), means2d[c]))
    if not outputs:
        size = (0, cameras.height, cameras.width)
        empty = torch.zeros(size, dtype=tensors.means.dtype, device=tensors.means.device)
        return RenderingTensors(torch.zeros((*size, 3)).to(empty), empty, empty, empty, means2d)
    images, alphas, depths, medians = (_stack(part) for part in zip(*outputs, strict=True))
    return RenderingTensors(images, alphas, depths, medians, means2d)


def _stack(parts: tuple[Tensor, ...]) -> Tensor:
    """Return tensors of single cameras as one stack."""
    return parts[0][None] if len(parts) == 1 else torch.stack(parts)  # one image need not be copied


_Draw = Callable[..., tuple[Tensor, Tensor, Tensor, Tensor]]


def _draw_cpu(
    tensors: GaussianTensors,
    camera: Cameras,
    background: NDArray[np.float32],
    degree: int,
    antialiased: bool,
    colors: Tensor | None,
    probe: Tensor,
    frozen: int = 0,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Render one camera with the kernels."""
    if tensors.means.device.type != "cpu":
        raise BackendError(
            f"backend 'cpu': expected tensors on the CPU, got {tensors.means.device}; use backend='cuda'"
        )
    view = View.from_matrices(camera.viewmats[0], camera.Ks[0], camera.width, camera.height)
    return rasterize_cpu(
        tensors,
        view,
        background=background,
        sh_degree=degree,
        antialiased=antialiased,
        colors=colors,
        probe=probe,
        frozen=Frozen(frozen),
    )


def _draw_reference(
    tensors: GaussianTensors,
    camera: Cameras,
    background: NDArray[np.float32],
    degree: int,
    antialiased: bool,
    colors: Tensor | None,
    probe: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Render one camera with plain torch."""
    size = camera.width, camera.height
    projection = project_reference(
        tensors, camera.viewmats[0], camera.Ks[0], *size, sh_degree=degree, antialiased=antialiased, colors=colors
    )
    shifted = replace(projection, means2d=projection.means2d + probe)
    drawn = blend_reference(tensors, shifted, *size, background)
    return drawn.image, drawn.alpha, drawn.depth, drawn.median_depth


def _draw_cuda(
    tensors: GaussianTensors,
    camera: Cameras,
    background: NDArray[np.float32],
    degree: int,
    antialiased: bool,
    colors: Tensor | None,
    probe: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Render one camera with gsplat."""
    reason = why_no_cuda()
    if reason:
        raise BackendError(reason)
    return rasterize_cuda(
        tensors, camera, background=background, sh_degree=degree, antialiased=antialiased, colors=colors, probe=probe
    )
