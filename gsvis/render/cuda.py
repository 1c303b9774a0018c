"""The CUDA rasterizer: calls gsplat, if it is installed and there is a GPU.

gsplat's classic conventions are those of gsvis (docs/conventions.md). gsplat has no median depth.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gsvis._extras import has, remedy_of
from gsvis.errors import BackendError
from gsvis.scene.cameras import Cameras
from gsvis.scene.lengths import length_factor

if TYPE_CHECKING:
    from torch import Tensor

    from gsvis.render.tensors import GaussianTensors

__all__ = ["choose_backend", "is_available", "rasterize_cuda"]


def is_available() -> str:
    """Return why the backend cannot run here, with what to install; empty if it can."""
    try:
        import torch
    except ImportError:
        return f"backend 'cuda': expected the package torch, got none; {remedy_of('torch')}"
    if not torch.cuda.is_available():
        return "backend 'cuda': expected a CUDA GPU and a torch build for it, got neither; use backend='cpu'"
    try:
        import gsplat  # noqa: F401
    except ImportError as error:
        return f"backend 'cuda': expected an importable gsplat, got '{error}'; {remedy_of('gsplat')}"
    return ""


def choose_backend(asked: str) -> str:
    """Return the backend to use: the one asked for; for "auto", "cuda" if it can run here, else "cpu".

    Raises:
        BackendError: If "cuda" is asked for and cannot run here.
    """
    if asked not in ("auto", "cuda"):
        return asked
    if asked == "auto" and not has("gsplat"):  # `is_available` imports torch, which takes longer than a small render
        return "cpu"
    missing = is_available()
    if asked == "cuda" and missing:
        raise BackendError(missing)
    return "cpu" if missing else "cuda"


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
    if probe.requires_grad:
        _forward_gradient(info["means2d"], probe)
    image = images[0, ..., :3]
    alpha = alphas[0, ..., 0]
    return image, alpha, images[0, ..., 3], torch.full_like(alpha, float("nan"))


def _forward_gradient(means2d: Tensor, probe: Tensor) -> None:
    """Pass the gradient of gsplat's projected centers on to the probe."""
    import torch

    def add(gradient: Tensor) -> Any:
        """Pass the gradient on to the probe, and return it."""
        torch.autograd.backward(probe, gradient.reshape(probe.shape).detach())
        return gradient

    means2d.register_hook(add)  # type: ignore[no-untyped-call]
