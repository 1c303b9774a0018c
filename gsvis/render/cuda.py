"""The CUDA rasterizer: calls gsplat. `gsvis.render.device` says whether it can.

gsplat's classic conventions are those of gsvis (docs/conventions.md). gsplat has no median depth.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.lengths import length_factor

if TYPE_CHECKING:
    from torch import Tensor

    from gsvis.render.tensors import GaussianTensors

__all__ = ["draw_one", "rasterize_cuda"]


def rasterize_cuda(
    tensors: GaussianTensors,
    camera: Cameras,
    *,
    background: NDArray[np.float32],
    sh_degree: int,
    antialiased: bool,
    colors: Tensor | None,
    probe: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Render one camera; the arguments are those of `gsvis.render.cpu.rasterize_cpu`, with tensors on a GPU.

    Returns:
        image (H, W, 3), alpha (H, W), expected depth (H, W), and NaN for the median depth (H, W).
    """
    import gsplat
    import torch

    device = tensors.means.device

    def to_device(array: NDArray[Any]) -> Tensor:
        """Return a copy of an array on the GPU."""
        return torch.tensor(array, dtype=torch.float32, device=device)  # a copy: arrays of cameras are read-only

    some = tensors.means.detach()[:: max(1, len(tensors.means) // 4096)]  # a sample: copying all would wait for the GPU
    near = 0.01 / length_factor(some.cpu().numpy())
    coefficients = torch.cat([tensors.sh0, tensors.shN], dim=1)[:, : (sh_degree + 1) ** 2]
    images, alphas, info = gsplat.rasterization(
        tensors.means,
        tensors.quats,
        tensors.scales,
        tensors.opacities,
        coefficients if colors is None else colors,
        to_device(camera.viewmats),
        to_device(camera.Ks),
        camera.width,
        camera.height,
        near_plane=near,
        eps2d=0.3,
        sh_degree=sh_degree if colors is None else None,
        packed=False,
        backgrounds=to_device(background[None]),
        render_mode="RGB+ED",
        rasterize_mode="antialiased" if antialiased else "classic",
    )
    if probe.requires_grad and info["means2d"].requires_grad:  # it does not if colors alone have gradients
        _forward_gradient(info["means2d"], probe)
    image = images[0, ..., :3]
    alpha = alphas[0, ..., 0]
    return image, alpha, images[0, ..., 3], torch.full_like(alpha, float("nan"))


def draw_one(device: str) -> None:
    """Draw one Gaussian on a torch device; raise what gsplat raises if it cannot, such as `RuntimeError`."""
    import torch

    from gsvis.render.tensors import GaussianTensors

    one = Gaussians([[0, 0, 0]], [[1, 0, 0, 0]], [[1, 1, 1]], [0.5], np.zeros((1, 1, 3)))
    camera = Cameras.look_at([[4.0, 0.0, 0.0]], (0.0, 0.0, 0.0), width=16, height=16)
    rasterize_cuda(
        GaussianTensors.from_gaussians(one, device=device),
        camera,
        background=np.zeros(3, np.float32),
        sh_degree=0,
        antialiased=False,
        colors=None,
        probe=torch.zeros(1, 2, device=device),
    )
    torch.cuda.synchronize()  # an error of a kernel is raised here


def _forward_gradient(means2d: Tensor, probe: Tensor) -> None:
    """Pass the gradient of gsplat's projected centers on to the probe."""
    import torch

    def add(gradient: Tensor) -> Any:
        """Pass the gradient on to the probe, and return it."""
        torch.autograd.backward(probe, gradient.reshape(probe.shape).detach())
        return gradient

    means2d.register_hook(add)  # type: ignore[no-untyped-call]
