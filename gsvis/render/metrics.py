"""Measure how much an image differs from its target: PSNR, SSIM, FLIP, LPIPS.

Images are RGB, channels last, sRGB values where 0 is black and `data_range` (1 by default) is white. One
image (H, W, 3) gives one value, a stack (C, H, W, 3) gives C. NumPy arrays give NumPy values or a float, torch tensors
give tensors on their device, differentiable in PSNR, SSIM and LPIPS (`gsvis.render.metrics_torch`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis._extras import require
from gsvis.render.metrics_numpy import Values, check_stacks, flip_map_numpy, flip_numpy, psnr_numpy, ssim_numpy

if TYPE_CHECKING:
    from torch import Tensor

__all__ = ["flip", "flip_map", "lpips", "psnr", "ssim"]


@overload
def psnr(image: Tensor, target: Tensor, data_range: float = 1.0) -> Tensor: ...
@overload
def psnr(image: ArrayLike, target: ArrayLike, data_range: float = 1.0) -> Values: ...
def psnr(image: Any, target: Any, data_range: float = 1.0) -> Tensor | Values:
    """Return the peak signal-to-noise ratio in dB; infinite for equal images.

    Args:
        image: (H, W, 3) or (C, H, W, 3).
        target: Same shape as `image`.
        data_range: Value of white, > 0.

    Returns:
        One value for one image, C values for a stack.

    Raises:
        ValueError: If shapes differ or are wrong, a value is not finite or `data_range` is not positive.

    Examples:
        >>> round(psnr(np.full((4, 4, 3), 0.6), np.full((4, 4, 3), 0.5)), 6)
        20.0
    """
    if _is_tensor(image, target):
        from gsvis.render.metrics_torch import psnr_torch

        return psnr_torch(image, target, data_range)
    return psnr_numpy(image, target, data_range)


@overload
def ssim(image: Tensor, target: Tensor, data_range: float = 1.0, *, padding: str = "valid") -> Tensor: ...
@overload
def ssim(image: ArrayLike, target: ArrayLike, data_range: float = 1.0, *, padding: str = "valid") -> Values: ...
def ssim(image: Any, target: Any, data_range: float = 1.0, *, padding: str = "valid") -> Tensor | Values:
    """Return the structural similarity, mean over pixels and channels: 1 for equal images.

    Windows are Gaussian, 11 x 11 with a standard deviation of 1.5 pixels; K1 = 0.01, K2 = 0.03.

    Args:
        image: (H, W, 3) or (C, H, W, 3).
        target: Same shape as `image`.
        data_range: Value of white, > 0.
        padding: "valid" uses only windows inside the image, as in the paper; "same" uses one window for each pixel,
            with black outside the image, as in the training loss of 3DGS.

    Returns:
        One value for one image, C values for a stack.

    Raises:
        ValueError: If shapes differ or are wrong, a value is not finite, `data_range` is not positive, or no window
            fits into the image.

    References:
        Wang et al., "Image quality assessment: from error visibility to structural similarity", TIP 2004.
    """
    _check.one_of("padding", padding, ("valid", "same"))
    if _is_tensor(image, target):
        from gsvis.render.metrics_torch import ssim_torch

        return ssim_torch(image, target, data_range, padding)
    return ssim_numpy(image, target, data_range, padding)


@overload
def flip(image: Tensor, target: Tensor, pixels_per_degree: float = 67.0) -> Tensor: ...
@overload
def flip(image: ArrayLike, target: ArrayLike, pixels_per_degree: float = 67.0) -> Values: ...
def flip(image: Any, target: Any, pixels_per_degree: float = 67.0) -> Tensor | Values:
    """Return the mean of the FLIP error map: the difference seen when flipping between two images, 0 to 1.

    Args:
        image: (H, W, 3) or (C, H, W, 3), sRGB; clipped to [0, 1] as a display does.
        target: Same shape as `image`.
        pixels_per_degree: Pixels per degree of the observer's field of view; 67 is a 0.7 m wide 4K display seen from
            0.7 m.

    Returns:
        One value for one image, C values for a stack. Without gradient.

    Raises:
        ValueError: If shapes differ or are wrong, a value is not finite or `pixels_per_degree` is not positive.
        BackendError: If the package flip-evaluator is absent.

    References:
        Andersson et al., "FLIP: a difference evaluator for alternating images", HPG 2020.
    """
    if _is_tensor(image, target):
        from gsvis.render.metrics_torch import flip_map_torch

        return flip_map_torch(image, target, pixels_per_degree).mean(dim=(-2, -1))
    return flip_numpy(image, target, pixels_per_degree)


@overload
def flip_map(image: Tensor, target: Tensor, pixels_per_degree: float = 67.0) -> Tensor: ...
@overload
def flip_map(image: ArrayLike, target: ArrayLike, pixels_per_degree: float = 67.0) -> NDArray[np.float64]: ...
def flip_map(image: Any, target: Any, pixels_per_degree: float = 67.0) -> Tensor | Values:
    """Return the (H, W) or (C, H, W) FLIP error of each pixel, 0 to 1; takes and raises the same as `flip`."""
    if _is_tensor(image, target):
        from gsvis.render.metrics_torch import flip_map_torch

        return flip_map_torch(image, target, pixels_per_degree)
    return flip_map_numpy(image, target, pixels_per_degree)


@overload
def lpips(image: Tensor, target: Tensor, net: str = "vgg") -> Tensor: ...
@overload
def lpips(image: ArrayLike, target: ArrayLike, net: str = "vgg") -> Values: ...
def lpips(image: Any, target: Any, net: str = "vgg") -> Tensor | Values:
    """Return the learned perceptual distance LPIPS: 0 for equal images.

    gsvis downloads nothing: the backbone's ImageNet weights must be in the folder where torch keeps them.

    Args:
        image: (H, W, 3) or (C, H, W, 3), values in [0, 1]; at least 32 x 32 pixels.
        target: Same shape as `image`.
        net: "vgg", which papers on radiance fields report, or "alex", which the authors of LPIPS recommend for
            comparing images.

    Returns:
        One value for one image, C values for a stack.

    Raises:
        ValueError: If shapes differ or are wrong, a value is not finite or `net` is unknown.
        BackendError: If the package lpips or the weights are absent.

    References:
        Zhang et al., "The unreasonable effectiveness of deep features as a perceptual metric", CVPR 2018.
    """
    _check.one_of("net", net, ("vgg", "alex"))
    tensors = _is_tensor(image, target)
    if not tensors:
        check_stacks(image, target)
    require("lpips", "torch")
    from gsvis.render.metrics_torch import lpips_torch

    values = lpips_torch(image, target, net)
    if tensors:
        return values
    array: NDArray[np.float64] = values.detach().double().numpy()
    return array if array.ndim else float(array)


def _is_tensor(image: Any, target: Any) -> bool:
    return _check.is_tensor(image) or _check.is_tensor(target)
