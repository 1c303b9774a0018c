"""Compute the training loss: the mean absolute difference of two images and their structural dissimilarity."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsvis.render.metrics import ssim
from gsvis.render.metrics_numpy import gaussian_window
from gsvis.train._kernels import loss as _kernels_loss

__all__ = ["photometric_loss"]

_WINDOW = gaussian_window().astype(np.float32)


def photometric_loss(image: Tensor, target: Tensor, ssim_weight: float = 0.2) -> Tensor:
    """Return (1 - s) mean |image - target| + s (1 - SSIM), with windows over black; differentiable by the image.

    Args:
        image: (H, W, 3) float32, 1 is white.
        target: (H, W, 3) float32, 1 is white.
        ssim_weight: s, in [0, 1].

    Raises:
        ValueError: If shapes differ or are wrong.

    References:
        Kerbl et al., "3D Gaussian splatting for real-time radiance field rendering", TOG 2023, equation 7.
    """
    if image.ndim != 3 or image.shape[-1] != 3 or image.shape != target.shape:
        raise ValueError(
            f"target: expected the shape (H, W, 3) of image, {tuple(image.shape)}, got {tuple(target.shape)}"
        )
    if image.device.type != "cpu" or image.dtype != torch.float32:
        return loss_reference(image, target, ssim_weight)
    loss: Tensor = _Loss.apply(image, target, ssim_weight)  # type: ignore[no-untyped-call]
    return loss


def loss_reference(image: Tensor, target: Tensor, ssim_weight: float) -> Tensor:
    """Return the loss from its parts, on any device; the slow twin of the kernels."""
    difference = (image - target).abs().mean()
    return (1.0 - ssim_weight) * difference + ssim_weight * (1.0 - ssim(image, target, padding="same"))


class _Loss(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor, ssim_weight: float) -> Tensor:
        """Return the loss; keep the derivatives of SSIM."""
        height = image.shape[0]
        a, b = (np.ascontiguousarray(t.detach().numpy()).reshape(height, -1) for t in (image, target))
        slopes = np.empty((3, *a.shape), np.float32)
        sums = np.empty((-(-height // _kernels_loss.ROWS), 2))
        _kernels_loss.compare(a, b, _WINDOW, slopes, sums)
        difference, likeness = sums.sum(axis=0) / a.size
        ctx.saved = a, b, slopes, ssim_weight, image.shape
        return image.new_tensor((1.0 - ssim_weight) * difference + ssim_weight * (1.0 - likeness))

    @staticmethod
    def backward(ctx: Any, *by_loss: Tensor) -> tuple[Tensor, None, None]:
        """Return the gradient by the image."""
        a, b, slopes, ssim_weight, shape = ctx.saved
        each = float(by_loss[0]) / a.size
        out = np.empty_like(a)
        _kernels_loss.slope(a, b, _WINDOW, slopes, each * (1.0 - ssim_weight), -each * ssim_weight, out)
        return torch.from_numpy(out.reshape(shape)), None, None
