"""Image metrics of NumPy arrays, and the checks that arrays and tensors share.

`gsvis.render.metrics` documents them; `gsvis.render.metrics_torch` does the same for tensors.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis._extras import missing
from gsvis.render._kernels.blur import blur

__all__ = [
    "WINDOW",
    "Values",
    "check_pair",
    "check_pixels",
    "check_stacks",
    "check_white",
    "check_window",
    "flip_map_numpy",
    "flip_maps",
    "flip_numpy",
    "gaussian_window",
    "psnr_numpy",
    "ssim_numpy",
]

F64 = NDArray[np.float64]
Values = float | F64

WINDOW = 11
"""Pixels across the window of SSIM."""
_SIGMA = 1.5


def psnr_numpy(image: Any, target: Any, data_range: float) -> Values:
    """Return PSNR in dB: a float for one image, (C,) for a stack."""
    a, b = check_stacks(image, target)
    error = np.square(a - b).mean(axis=(1, 2, 3))
    with np.errstate(divide="ignore"):
        return _unstack(image, 10.0 * np.log10(check_white(data_range) ** 2 / error))


def ssim_numpy(image: Any, target: Any, data_range: float, padding: str) -> Values:
    """Return SSIM: a float for one image, (C,) for a stack."""
    a, b = check_stacks(image, target)
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
    return _unstack(image, values)


def flip_numpy(image: Any, target: Any, pixels_per_degree: float) -> Values:
    """Return the mean FLIP error: a float for one image, (C,) for a stack."""
    return _unstack(image, flip_maps(*check_stacks(image, target), pixels_per_degree).mean(axis=(1, 2)))


def flip_map_numpy(image: Any, target: Any, pixels_per_degree: float) -> Values:
    """Return the (H, W) or (C, H, W) FLIP error of each pixel."""
    return _unstack(image, flip_maps(*check_stacks(image, target), pixels_per_degree))


def check_stacks(image: Any, target: Any) -> tuple[F64, F64]:
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


def _unstack(image: Any, values: F64) -> Values:
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
