"""Colors that look evenly spaced: OKLab, a ramp for quantities, and a palette for categories.

OKLab is made so that equal distances look equally different. sRGB here is the gamma-coded one of displays and of 3DGS,
each channel in [0, 1].

References:
    B. Ottosson, "A perceptual color space for image processing", 2020.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check

__all__ = ["oklab_to_srgb", "palette", "ramp", "srgb_to_oklab"]

F64 = NDArray[np.float64]

_CONES = np.array(
    [
        [0.4122214708, 0.5363325363, 0.0514459929],
        [0.2119034982, 0.6806995451, 0.1073969566],
        [0.0883024619, 0.2817188376, 0.6299787005],
    ]
)
"""Responses of the eye to linear sRGB."""
_LAB = np.array(
    [
        [0.2104542553, 0.7936177850, -0.0040720468],
        [1.9779984951, -2.4285922050, 0.4505937099],
        [0.0259040371, 0.7827717662, -0.8086757660],
    ]
)
"""OKLab of the cube roots of the responses."""

# lightness at the ends of the ramp
_DARK = 0.28
_BRIGHT = 0.93
_HUES = (305.0, 100.0)  # degrees: purple, over blue and green, to yellow
_CHROMA = 0.13
_GOLDEN = 137.50776405003785  # degrees; the golden angle sets hues of consecutive numbers far apart
_STEPS = 24  # bisection steps for the largest chroma that a display can show


def oklab_to_srgb(lab: ArrayLike) -> F64:
    """Return (N, 3) sRGB of (N, 3) OKLab; not clipped, so that channels outside [0, 1] cannot be shown."""
    values = _check.floats("lab", lab, ("N", 3), np.float64)
    linear = np.linalg.solve(_CONES, (np.linalg.solve(_LAB, values.T)) ** 3).T
    size = np.abs(linear)
    coded = np.where(size <= 0.0031308, 12.92 * size, 1.055 * np.maximum(size, 1e-12) ** (1.0 / 2.4) - 0.055)
    return np.asarray(np.sign(linear) * coded)


def srgb_to_oklab(rgb: ArrayLike) -> F64:
    """Return (N, 3) OKLab of (N, 3) sRGB: lightness in [0, 1], green to red, blue to yellow."""
    values = _check.floats("rgb", rgb, ("N", 3), np.float64)
    size = np.abs(values)
    linear = np.sign(values) * np.where(size <= 0.04045, size / 12.92, ((size + 0.055) / 1.055) ** 2.4)
    return np.asarray((_LAB @ np.cbrt(_CONES @ linear.T)).T)


def ramp(parts: ArrayLike) -> F64:
    """Return colors for shares in [0, 1], from dark purple for 0 to bright yellow for 1; equal steps look alike.

    Lightness grows evenly, so the order remains visible without color vision and in gray prints.

    Args:
        parts: (N,) in [0, 1].

    Returns:
        (N, 3) sRGB in [0, 1].

    Raises:
        ValueError: If a value is out of range.

    Examples:
        >>> ramp([0.0, 1.0]).round(2).tolist()
        [[0.22, 0.04, 0.35], [0.99, 0.92, 0.5]]
    """
    values = _check.floats("parts", parts, ("N",), np.float64)
    _check.in_range("parts", values, 0.0, 1.0)
    hues = _HUES[0] + values * (_HUES[1] - _HUES[0])
    return _displayable(_DARK + values * (_BRIGHT - _DARK), np.full(len(values), _CHROMA), hues)


def palette(count: int) -> F64:
    """Return (count, 3) sRGB colors of categories; consecutive colors differ much in hue and lightness."""
    numbers = np.arange(_check.positive_int("count", count, at_least=0))
    return _displayable(
        np.array([0.78, 0.55, 0.68])[numbers % 3], np.full(count, _CHROMA), np.asarray(_GOLDEN * numbers, np.float64)
    )


def _displayable(lightness: F64, chroma: F64, hues: F64) -> F64:
    """Return sRGB of lightness, chroma and hue (degrees), with as much of the chroma as a display can show."""
    around = np.stack([np.cos(np.radians(hues)), np.sin(np.radians(hues))], axis=1)
    low = np.zeros(len(hues))
    high = chroma.astype(np.float64)
    for _ in range(_STEPS):
        middle = 0.5 * (low + high)
        rgb = oklab_to_srgb(np.column_stack([lightness, middle[:, None] * around]))
        fits = np.all((rgb >= 0.0) & (rgb <= 1.0), axis=1)
        low = np.where(fits, middle, low)
        high = np.where(fits, high, middle)
    return np.clip(oklab_to_srgb(np.column_stack([lightness, low[:, None] * around])), 0.0, 1.0)
