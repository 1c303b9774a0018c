"""Measure how much an image differs from its target: PSNR, SSIM, FLIP, LPIPS.

Images are RGB, channels last, sRGB values where 0 is black and `data_range` (1 by default) is white. One
image (H, W, 3) gives one value, a stack (C, H, W, 3) gives C. NumPy arrays give NumPy values or a float, torch tensors
give tensors on their device, differentiable in PSNR, SSIM and LPIPS (`gsvis.render.metrics_torch`).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis._extras import missing, require
from gsvis.render._kernels.blur import blur

if TYPE_CHECKING:
    from torch import Tensor

__all__ = ["flip", "flip_map", "lpips", "psnr", "ssim"]

F64 = NDArray[np.float64]
Values = float | F64

WINDOW = 11
"""Pixels across the window of SSIM."""
_SIGMA = 1.5


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
    a, b = _pair(image, target)
    error = np.square(a - b).mean(axis=(1, 2, 3))
    with np.errstate(divide="ignore"):
        return _like(image, 10.0 * np.log10(check_white(data_range) ** 2 / error))


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
    a, b = _pair(image, target)
    check_window(a.shape, padding)
    white = check_white(data_range)
    c1 = (0.01 * white) ** 2
    c2 = (0.03 * white) ** 2
    values = np.empty(len(a))
    for c in range(len(a)):
        x, y = (np.ascontiguousarray(v[c].transpose(2, 0, 1)) for v in (a, b))
        means = _blur(np.concatenate([x, y, x * x, y * y, x * y]), WINDOW // 2 if padding == "same" else 0)
        mx, my, mxx, myy, mxy = np.split(means, 5)
        luminance = (2.0 * mx * my + c1) / (mx * mx + my * my + c1)
        structure = (2.0 * (mxy - mx * my) + c2) / ((mxx - mx * mx) + (myy - my * my) + c2)
        values[c] = (luminance * structure).mean()
    return _like(image, values)


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
    return _like(image, flip_maps(*_pair(image, target), pixels_per_degree).mean(axis=(1, 2)))


@overload
def flip_map(image: Tensor, target: Tensor, pixels_per_degree: float = 67.0) -> Tensor: ...
@overload
def flip_map(image: ArrayLike, target: ArrayLike, pixels_per_degree: float = 67.0) -> NDArray[np.float64]: ...
def flip_map(image: Any, target: Any, pixels_per_degree: float = 67.0) -> Tensor | Values:
    """Return the (H, W) or (C, H, W) FLIP error of each pixel, 0 to 1; takes and raises the same as `flip`."""
    if _is_tensor(image, target):
        from gsvis.render.metrics_torch import flip_map_torch

        return flip_map_torch(image, target, pixels_per_degree)
    return _like(image, flip_maps(*_pair(image, target), pixels_per_degree))


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
        _pair(image, target)
    require("lpips", "torch")
    from gsvis.render.metrics_torch import lpips_torch

    values = lpips_torch(image, target, net)
    if tensors:
        return values
    array: F64 = values.detach().double().numpy()
    return array if array.ndim else float(array)


def _is_tensor(image: Any, target: Any) -> bool:
    return _check.is_tensor(image) or _check.is_tensor(target)


def _pair(image: Any, target: Any) -> tuple[F64, F64]:
    """Return both images as checked (C, H, W, 3) arrays."""
    a = _stack("image", image)
    b = _stack("target", target)
    check_pair(a.shape, b.shape, image, target)
    return a, b


def _stack(name: str, value: Any) -> F64:
    """Return an image or a stack as a checked (C, H, W, 3) array."""
    shape: tuple[int | str, ...] = ("H", "W", 3) if np.ndim(value) == 3 else ("C", "H", "W", 3)
    if np.asarray(value).dtype == np.uint8:
        raise ValueError(f"{name}: expected floats, got bytes; divide them by 255")
    array: F64 = _check.floats(name, value, shape, np.float64)
    check_pixels(name, array.shape)
    return array if array.ndim == 4 else array[None]


def _like(image: Any, values: F64) -> Values:
    """Return (C, ...) values for a stack; for one image, its value alone."""
    values = values[0] if np.ndim(image) == 3 else values
    return values if np.ndim(values) else float(values)


def check_pair(a: tuple[int, ...], b: tuple[int, ...], image: Any, target: Any) -> None:
    """Raise unless two images or stacks have the same shape; `a` and `b` are their shapes as stacks."""
    if a != b or np.ndim(image) != np.ndim(target):
        raise ValueError(
            f"target: expected the shape of image, {tuple(np.shape(image))}, got {tuple(np.shape(target))}"
        )


def check_pixels(name: str, shape: tuple[int, ...]) -> None:
    """Raise unless an image or a stack has a pixel."""
    if 0 in shape[-3:]:
        raise ValueError(f"{name}: expected at least one pixel, got shape {tuple(shape)}")


def check_window(shape: tuple[int, ...], padding: str) -> None:
    """Raise unless a window of SSIM fits into images (C, H, W, 3)."""
    if padding == "valid" and min(shape[1:3]) < WINDOW:
        raise ValueError(
            f"image: expected at least {WINDOW} x {WINDOW} pixels, got {shape[2]} x {shape[1]}; "
            "padding='same' takes any size"
        )


def check_white(data_range: float) -> float:
    """Return the value of white; raise unless it is positive."""
    if not 0.0 < data_range < math.inf:
        raise ValueError(f"data_range: expected a finite number > 0, got {data_range!r}")
    return float(data_range)


def gaussian_window() -> F64:
    """Return the (WINDOW,) weights of SSIM's window along one axis."""
    window = np.exp(-0.5 * ((np.arange(WINDOW) - WINDOW // 2) / _SIGMA) ** 2)
    return np.asarray(window / window.sum())


def _blur(planes: F64, margin: int) -> F64:
    """Return (B, H, W) planes, padded by `margin` zeros and blurred with the Gaussian window; only whole windows."""
    less = 2 * margin - WINDOW + 1
    out = np.empty((len(planes), planes.shape[1] + less, planes.shape[2] + less))
    blur(planes, gaussian_window(), margin, out)
    return out


def flip_maps(image: NDArray[np.floating[Any]], target: NDArray[np.floating[Any]], pixels_per_degree: float) -> F64:
    """Return the (C, H, W) FLIP error of each pixel of checked stacks (C, H, W, 3).

    Raises:
        ValueError: If `pixels_per_degree` is not positive.
        BackendError: If the package flip-evaluator is absent.
    """
    if not 0.0 < pixels_per_degree < math.inf:
        raise ValueError(f"pixels_per_degree: expected a finite number > 0, got {pixels_per_degree!r}")
    try:
        from flip_evaluator import evaluate
    except ImportError as error:
        raise missing("flip", "flip_evaluator") from error
    a, b = (np.ascontiguousarray(np.clip(v, 0.0, 1.0), np.float32) for v in (image, target))
    maps = [
        evaluate(
            reference,
            test,
            "LDR",
            inputsRGB=True,
            applyMagma=False,
            computeMeanError=False,
            parameters={"ppd": float(pixels_per_degree)},
        )[0]
        for test, reference in zip(a, b, strict=True)
    ]
    return np.stack(maps)[..., 0].astype(np.float64) if maps else np.zeros(a.shape[:3])
