"""Colors that replace SH when tensors are drawn; `gsvis.render.colors` does the same for arrays.

SRBF colors are evaluated for one camera at a time, when it is drawn.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsvis import _check
from gsvis.color.evaluate import Evaluator
from gsvis.color.evaluate_torch import SrbfTensors, evaluate_torch
from gsvis.color.srbf import SrbfColors
from gsvis.render.colors import Colors, check_color_shape, check_count
from gsvis.render.tensors import GaussianTensors
from gsvis.scene.cameras import Cameras

__all__ = ["CameraColors", "TensorColors", "camera_colors_torch"]

TensorColors = Tensor | SrbfTensors


@dataclass(frozen=True, eq=False)
class CameraColors:
    """The colors for each camera.

    Attributes:
        of: Function from the number of a camera to (N, 3) RGB of the Gaussians' type, or to None for SH colors.
        requires_grad: Whether the colors have gradients of their own.
    """

    of: Callable[[int], Tensor | None]
    requires_grad: bool


def camera_colors_torch(
    colors: Colors | TensorColors, tensors: GaussianTensors, cameras: Cameras, backend: str
) -> CameraColors:
    """Check the colors given to `rasterize`, and return the colors for each camera.

    Args:
        colors: The argument `colors` of `rasterize`.
        tensors: The N Gaussians.
        cameras: The C cameras.
        backend: Name of the backend that draws; "cpu" evaluates SRBF with kernels, unless gradients are needed.

    Raises:
        ValueError: If there is not one color for each Gaussian, or a value is not finite.
    """
    if colors is None:
        return CameraColors(lambda c: None, False)
    if not isinstance(colors, SrbfColors | SrbfTensors | Evaluator):
        given = _check_given(colors, len(tensors), len(cameras)).to(tensors.means)
        return CameraColors(lambda c: given[c if len(given) > 1 else 0], given.requires_grad)
    check_count(colors, len(tensors))
    eyes = cameras.viewpoints
    training = torch.is_grad_enabled() and any(t.requires_grad for t in vars(tensors).values())
    if backend == "cpu" and not training and not isinstance(colors, SrbfTensors):
        evaluator = colors if isinstance(colors, Evaluator) else Evaluator(colors)
        means = tensors.means.detach().cpu().numpy()
        return CameraColors(lambda c: torch.from_numpy(evaluator.colors(means, eyes[c])).to(tensors.means), False)
    if not isinstance(colors, SrbfTensors):
        source = colors.source if isinstance(colors, Evaluator) else colors
        if source is None:
            raise ValueError("colors: expected an Evaluator that keeps its colors, got one with keep=False")
        colors = SrbfTensors.from_colors(source, tensors.means.dtype, tensors.means.device)
    terms = colors

    def evaluate_for(c: int) -> Tensor:
        """Return the colors for camera c."""
        found = evaluate_torch(terms, tensors.means, eyes[c]).to(tensors.means)
        return found if training or found.requires_grad else _finite(found)  # training checks only shapes

    return CameraColors(evaluate_for, terms.requires_grad)


def _check_given(colors: Any, n: int, cameras: int) -> Tensor:
    """Return checked colors as a (1, N, 3) or (C, N, 3) tensor."""
    if isinstance(colors, Tensor):
        given = colors
    else:
        given = torch.from_numpy(np.require(_check.floats("colors", colors, np.shape(colors)), requirements="W"))
    check_color_shape(given.shape, n, cameras)
    return _finite(given if given.ndim == 3 else given[None])


def _finite(colors: Tensor) -> Tensor:
    """Return the colors; raise if a value is not finite."""
    if not bool(torch.isfinite(colors.detach()).all()):
        raise ValueError("colors: expected finite values, got NaN or infinity")
    return colors
