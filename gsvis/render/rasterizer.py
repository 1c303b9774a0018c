"""Render images of Gaussians from cameras: arrays in and arrays out, or tensors in and tensors out.

Conventions: docs/conventions.md, OpenCV cameras, pixel centers at +0.5, colors not clipped above. The backends differ
mainly in speed: `cpu` (numba, float32), `reference` (plain NumPy or torch, slow), `cuda` (gsplat, no median depth).
Only tensors and `cuda` need torch; `gsvis.render.rasterizer_torch` draws them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.errors import BackendError
from gsvis.render.colors import Colors, camera_colors
from gsvis.render.device import torch_device_of, why_no_cuda
from gsvis.render.reference import draw_reference
from gsvis.render.splats import View, check_no_skew, draw
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians

if TYPE_CHECKING:
    from gsvis.render.colors_torch import TensorColors
    from gsvis.render.rasterizer_torch import RenderingTensors
    from gsvis.render.tensors import GaussianTensors

__all__ = ["BACKENDS", "Rendering", "rasterize"]

BACKENDS = ("auto", "cpu", "cuda", "reference")

F32 = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Rendering:
    """Images of C cameras, as float32 arrays.

    Attributes:
        images: (C, H, W, 3) RGB, 0 black, 1 white, brighter values kept.
        alphas: (C, H, W) in [0, 1], one minus the remaining transmittance.
        depths: (C, H, W) expected camera z, weighted by blending weights; 0 where nothing is seen.
        median_depths: (C, H, W) camera z of the first Gaussian behind which transmittance is at most 0.5; 0 if there is
            none; NaN with the backend `cuda`.
    """

    images: F32
    alphas: F32
    depths: F32
    median_depths: F32


@overload
def rasterize(
    gaussians: GaussianTensors,
    cameras: Cameras,
    *,
    backend: str = "auto",
    background: ArrayLike = (0.0, 0.0, 0.0),
    sh_degree: int | None = None,
    antialiased: bool | None = None,
    colors: Colors | TensorColors = None,
    frozen: int = 0,
) -> RenderingTensors: ...
@overload
def rasterize(
    gaussians: Gaussians,
    cameras: Cameras,
    *,
    backend: str = "auto",
    background: ArrayLike = (0.0, 0.0, 0.0),
    sh_degree: int | None = None,
    antialiased: bool | None = None,
    colors: TensorColors,
    frozen: int = 0,
) -> RenderingTensors: ...
@overload
def rasterize(
    gaussians: Gaussians,
    cameras: Cameras,
    *,
    backend: str = "auto",
    background: ArrayLike = (0.0, 0.0, 0.0),
    sh_degree: int | None = None,
    antialiased: bool | None = None,
    colors: Colors = None,
    frozen: int = 0,
) -> Rendering: ...
def rasterize(
    gaussians: Gaussians | GaussianTensors,
    cameras: Cameras,
    *,
    backend: str = "auto",
    background: ArrayLike = (0.0, 0.0, 0.0),
    sh_degree: int | None = None,
    antialiased: bool | None = None,
    colors: Any = None,
    frozen: int = 0,
) -> Rendering | RenderingTensors:
    """Render Gaussians from cameras; differentiable if the inputs are tensors that require gradients.

    Args:
        gaussians: N Gaussians, as arrays or as tensors. If tensors require gradients, only shapes are checked, to keep
            training fast; a Gaussian with a NaN or an infinity is not drawn.
        cameras: C cameras of one size, without skew.
        backend: "cpu", "cuda", "reference", or "auto": cuda for tensors on a GPU, else cpu.
        background: (3,) RGB behind everything.
        sh_degree: Highest degree to evaluate; None means the degree of the scene.
        antialiased: Lower opacities so that the blur of 0.3 square pixels keeps their integral. None follows the facts
            of the scene; tensors have none.
        colors: Colors that replace SH: (N, 3) or (C, N, 3) RGB, or SRBF colors of the N Gaussians, evaluated from the
            viewpoint of each camera. SRBF colors are `SrbfColors`, an `Evaluator` to share work between calls, or
            `SrbfTensors`, which may require gradients.
        frozen: Number of Gaussians, from the first on, that receive no gradients except those of `means2d`. This saves
            most of their share of the backward pass on the CPU. Has no effect for arrays.

    Returns:
        Images, alphas and depths: `RenderingTensors` if the Gaussians or the colors are tensors, else a `Rendering` of
        arrays.

    Raises:
        ValueError: If an argument has the wrong shape, is not finite or is out of range.
        BackendError: If the backend cannot run here; the message says what to install.
    """
    _check.one_of("backend", backend, BACKENDS)
    of_tensors = _is_gaussian_tensors(gaussians)
    if not isinstance(gaussians, Gaussians) and not of_tensors:
        raise ValueError(f"gaussians: expected Gaussians or GaussianTensors, got {type(gaussians).__name__}")
    check_no_skew(cameras)
    behind: F32 = _check.floats("background", background, (3,))
    degree = gaussians.sh_degree if sh_degree is None else min(_sh_degree(sh_degree), gaussians.sh_degree)
    _check.positive_int("frozen", frozen, at_least=0)
    if antialiased is None:
        antialiased = isinstance(gaussians, Gaussians) and gaussians.facts.antialiased
    if isinstance(gaussians, Gaussians) and backend != "cuda" and not _are_tensors(colors):
        draw_one: _Draw = draw_reference if backend == "reference" else draw
        draw_one = partial(draw_one, background=behind, sh_degree=degree, antialiased=antialiased)
        return _draw_arrays(gaussians, cameras, colors, draw_one)
    if backend == "cuda" and (reason := why_no_cuda()):
        raise BackendError(reason)
    from gsvis.render.rasterizer_torch import rasterize_tensors
    from gsvis.render.tensors import GaussianTensors

    if isinstance(gaussians, Gaussians):
        gaussians = GaussianTensors.from_gaussians(gaussians, device=torch_device_of(backend) or "cpu")
    drawn = rasterize_tensors(
        gaussians,
        cameras,
        backend=backend,
        background=behind,
        sh_degree=degree,
        antialiased=antialiased,
        colors=colors,
        frozen=frozen,
    )
    if of_tensors or _are_tensors(colors):
        return drawn
    return Rendering(*(_check.plain(part) for part in (drawn.images, drawn.alphas, drawn.depths, drawn.median_depths)))


def _is_gaussian_tensors(gaussians: Any) -> bool:
    """Return whether this is `GaussianTensors`. Imports torch only if needed."""
    if not _check.is_tensor(getattr(gaussians, "means", None)):
        return False
    from gsvis.render.tensors import GaussianTensors

    return isinstance(gaussians, GaussianTensors)


_Draw = Callable[..., tuple[F32, F32, F32, F32]]


def _draw_arrays(gaussians: Gaussians, cameras: Cameras, colors: Colors, draw_one: _Draw) -> Rendering:
    """Render arrays from all cameras with `draw_one`."""
    color_of = camera_colors(colors, gaussians.means, cameras)
    drawn = []
    for c in range(len(cameras)):
        view = View.from_matrices(cameras.viewmats[c], cameras.Ks[c], cameras.width, cameras.height)
        drawn.append(draw_one(gaussians, view, colors=color_of(c)))
    if not drawn:
        size = (0, cameras.height, cameras.width)
        return Rendering(np.zeros((*size, 3), np.float32), *(np.zeros(size, np.float32) for _ in range(3)))
    return Rendering(*(part[0][None] if len(part) == 1 else np.stack(part) for part in zip(*drawn, strict=True)))


def _are_tensors(colors: Any) -> bool:
    """Return whether colors are a tensor or `SrbfTensors`; an array whose memory belongs to a tensor is an array."""
    return _check.is_tensor(colors if isinstance(colors, np.ndarray) else getattr(colors, "base", colors))


def _sh_degree(value: int) -> int:
    """Return a checked SH degree."""
    if _check.positive_int("sh_degree", value, at_least=0) > 3:
        raise ValueError(f"sh_degree: expected 0 to 3, got {value}")
    return value
