"""Images of Gaussians from cameras: one call, four backends that agree.

Conventions: DESIGN decision 10, OpenCV cameras, pixel centers at +0.5, colors not clipped above. The backends differ
in speed alone: `cpu` (numba, float32), `reference` (plain torch, any float type, slow), `cuda` (gsplat).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from gsvis import _check
from gsvis.errors import BackendError
from gsvis.render.colors import Colors, camera_colors
from gsvis.render.cpu import rasterize_cpu
from gsvis.render.cuda import is_available, rasterize_cuda
from gsvis.render.reference import rasterize_reference
from gsvis.render.splats import View
from gsvis.render.tensors import GaussianTensors
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians

__all__ = ["BACKENDS", "Rendering", "rasterize"]

BACKENDS = ("auto", "cpu", "cuda", "reference")


@dataclass(frozen=True, eq=False)
class Rendering:
    """Images of C cameras, as torch tensors on the Gaussians' device.

    Attributes:
        images: (C, H, W, 3) RGB, 0 black, 1 white, brighter values kept.
        alphas: (C, H, W) in [0, 1], one minus the transmittance left.
        depths: (C, H, W) expected camera z, weighted by blending weights; 0 where nothing is seen.
        median_depths: (C, H, W) camera z of the Gaussian behind which at most half of the light is left; 0 where more
            is, NaN from gsplat, which has none.
        means2d: (C, N, 2) zeros; if gradients are taken, `means2d.grad` holds the gradient of the loss by the projected
            centers, per pixel, which densification needs.
    """

    images: Tensor
    alphas: Tensor
    depths: Tensor
    median_depths: Tensor
    means2d: Tensor


def rasterize(
    gaussians: Gaussians | GaussianTensors,
    cameras: Cameras,
    *,
    backend: str = "auto",
    background: ArrayLike = (0.0, 0.0, 0.0),
    sh_degree: int | None = None,
    antialiased: bool = False,
    colors: Colors = None,
    frozen: int = 0,
) -> Rendering:
    """Draw Gaussians as the cameras see them; differentiable where the inputs are tensors that ask for gradients.

    Args:
        gaussians: N Gaussians. Of tensors that gather gradients shapes alone are checked, since a training step should
            not pay for more; a Gaussian with values that are not finite is then not drawn.
        cameras: C cameras of one size, without skew.
        backend: "cpu", "cuda", "reference", or "auto": cuda for tensors on a GPU, else cpu.
        background: (3,) RGB behind everything.
        sh_degree: Highest degree to evaluate; None means all there is.
        antialiased: Lower opacities so that the blur of 0.3 square pixels keeps their integral.
        colors: Instead of SH: (N, 3) or (C, N, 3) RGB, or SRBF colors of the N Gaussians, evaluated for each camera
            from its viewpoint; as `SrbfColors`, as an `Evaluator` where many calls share them, or as `SrbfTensors`,
            which may gather gradients.
        frozen: The first so many Gaussians gather no gradients but those of `means2d`; saves most of their share of the
            backward pass on the CPU.

    Returns:
        Images, alphas and depths.

    Raises:
        ValueError: If an argument has the wrong shape, is not finite or is out of range.
        BackendError: If the backend cannot run here; says what to install.
    """
    _check.one_of("backend", backend, BACKENDS)
    tensors = GaussianTensors.from_gaussians(gaussians) if isinstance(gaussians, Gaussians) else gaussians
    if not isinstance(tensors, GaussianTensors):
        raise ValueError(f"gaussians: expected Gaussians or GaussianTensors, got {type(gaussians).__name__}")
    if np.abs(cameras.Ks[:, 0, 1]).max(initial=0.0) > 0.0:
        raise ValueError("cameras: expected Ks without skew (Ks[:, 0, 1] == 0); undistort the images first")
    behind = _check.floats("background", background, (3,))
    degree = tensors.sh_degree if sh_degree is None else min(_sh_degree(sh_degree), tensors.sh_degree)
    if backend == "auto":
        backend = "cuda" if tensors.means.is_cuda else "cpu"
    per_camera = camera_colors(colors, tensors, cameras, backend)
    draw: _Draw = {"cpu": _draw_cpu, "cuda": _draw_cuda, "reference": _draw_reference}[backend]
    _check.positive_int("frozen", frozen, at_least=0)
    takes_gradient = torch.is_grad_enabled() and (
        per_camera.requires_grad or any(t.requires_grad for t in vars(tensors).values())
    )
    if tensors is gaussians and not takes_gradient:
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
        outputs.append(draw(tensors, cameras[c], behind, degree, antialiased, per_camera.of(c), means2d[c]))
    if not outputs:
        size = (0, cameras.height, cameras.width)
        empty = torch.zeros(size, dtype=tensors.means.dtype, device=tensors.means.device)
        return Rendering(torch.zeros((*size, 3)).to(empty), empty, empty, empty, means2d)
    images, alphas, depths, medians = (_stack(part) for part in zip(*outputs, strict=True))
    return Rendering(images, alphas, depths, medians, means2d)


def _stack(parts: tuple[Tensor, ...]) -> Tensor:
    return parts[0][None] if len(parts) == 1 else torch.stack(parts)  # one image need not be copied


_Draw = Callable[..., tuple[Tensor, Tensor, Tensor, Tensor]]


def _draw_cpu(
    tensors: GaussianTensors, camera: Cameras, background: NDArray[np.float32], degree: int, antialiased: bool,
    colors: Tensor | None, probe: Tensor, frozen: int = 0,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    if tensors.means.device.type != "cpu":
        raise BackendError(
            f"backend 'cpu': expected tensors on the CPU, got {tensors.means.device}; use backend='cuda'"
        )
    view = View.from_matrices(camera.viewmats[0], camera.Ks[0], camera.width, camera.height)
    return rasterize_cpu(
        tensors, view, background=background, sh_degree=degree, antialiased=antialiased, colors=colors, probe=probe,
        frozen=frozen,
    )  # fmt: skip


def _draw_reference(
    tensors: GaussianTensors, camera: Cameras, background: NDArray[np.float32], degree: int, antialiased: bool,
    colors: Tensor | None, probe: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    drawn = rasterize_reference(
        tensors, camera.viewmats[0], camera.Ks[0], camera.width, camera.height,
        background=background, sh_degree=degree, antialiased=antialiased, colors=colors, shift2d=probe,
    )  # fmt: skip
    return drawn.image, drawn.alpha, drawn.depth, drawn.median_depth


def _draw_cuda(
    tensors: GaussianTensors, camera: Cameras, background: NDArray[np.float32], degree: int, antialiased: bool,
    colors: Tensor | None, probe: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    reason = is_available()
    if reason:
        raise BackendError(reason)
    return rasterize_cuda(
        tensors, camera, background=background, sh_degree=degree, antialiased=antialiased, colors=colors, probe=probe
    )


def _sh_degree(value: int) -> int:
    if _check.positive_int("sh_degree", value, at_least=0) > 3:
        raise ValueError(f"sh_degree: expected 0 to 3, got {value}")
    return value
