"""Convert colors: HSL, HSV and YUV, back to RGB, and the derivatives of RGB.

RGB values are those of a scene's colors (sRGB, 0 black, 1 white), channels last; hue is in turns. Every function takes
NumPy arrays (float64 stays, all else becomes float32) and returns NumPy arrays, or takes torch tensors and returns
tensors of their dtype on their device, with gradients that are finite everywhere. It knows no Gaussians.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis.color._kinds import channels, numbers

if TYPE_CHECKING:
    from torch import Tensor

__all__ = [
    "hsl_to_rgb",
    "hsv_to_rgb",
    "hue_vector",
    "rgb_by_hsl_lightness",
    "rgb_by_hsl_saturation",
    "rgb_by_hsv_saturation",
    "rgb_by_hsv_value",
    "rgb_by_yuv_luma",
    "rgb_to_hsl",
    "rgb_to_hsv",
    "rgb_to_yuv",
    "yuv_to_rgb",
]

Floats = NDArray[np.floating[Any]]

_RED = 0.299
_GREEN = 0.587
_BLUE = 0.114
"""Weights of luma: ITU-R BT.601-7, section 2.5.1."""
_INF = float("inf")
_SCALE = "divide the colors of each Gaussian by their largest value and keep that scale"


def _hsl(hsl: Any) -> Any:
    """Return the module, and checked H, S, L."""
    return channels("hsl", hsl, (-_INF, 0.0, 0.0), (_INF, 1.0, 1.0), "clip saturation and lightness to [0, 1]")


def _hsv(hsv: Any) -> Any:
    """Return the module, and checked H, S, V."""
    remedy = "clip saturation to [0, 1] and value below at 0"
    return channels("hsv", hsv, (-_INF, 0.0, 0.0), (_INF, 1.0, _INF), remedy)


@overload
def rgb_to_hsl(rgb: Tensor) -> Tensor: ...
@overload
def rgb_to_hsl(rgb: ArrayLike) -> Floats: ...
def rgb_to_hsl(rgb: Any) -> Any:
    """Convert RGB to hue, saturation, lightness.

    L = (max + min) / 2, S = (max - min) / (1 - |2 L - 1|). Gray, black and white have hue 0 and saturation 0. There,
    and where max - min is below 16 times the smallest normal number, hue and saturation carry no gradient.

    Args:
        rgb: (..., 3) in [0, 1]. Tensors are not checked: outside the range the result is finite but meaningless.

    Returns:
        (..., 3) hue in turns [0, 1), saturation and lightness in [0, 1].

    Raises:
        ValueError: If the shape is wrong or an array has values that are not finite or not in [0, 1].

    Examples:
        >>> rgb_to_hsl([[1.0, 0.0, 0.0], [0.5, 0.5, 0.5], [0.0, 0.0, 0.5]])
        array([[0.        , 1.        , 0.5       ],
               [0.        , 0.        , 0.5       ],
               [0.66666667, 1.        , 0.25      ]])
    """
    xp, r, g, b = channels("rgb", rgb, (0.0,) * 3, (1.0,) * 3, _SCALE)
    most, least = _largest_and_smallest(xp, r, g, b)
    lightness = (most + least) / 2
    room = xp.where(lightness <= 0.5, most + least, (1 - most) + (1 - least))
    return xp.concatenate([_hue(xp, r, g, b), _ratio(xp, most - least, room), lightness], -1)


@overload
def hsl_to_rgb(hsl: Tensor) -> Tensor: ...
@overload
def hsl_to_rgb(hsl: ArrayLike) -> Floats: ...
def hsl_to_rgb(hsl: Any) -> Any:
    """Convert HSL to RGB, the inverse of `rgb_to_hsl`: rgb = L + S (1 - |2 L - 1|) (h(H) - 1/2), h being `hue_vector`.

    Args:
        hsl: (..., 3) hue in turns, any finite number; saturation and lightness in [0, 1], unchecked in tensors.

    Returns:
        (..., 3) in [0, 1].

    Raises:
        ValueError: If the shape is wrong or an array has values that are not finite or out of their range.
    """
    xp, hue, saturation, lightness = _hsl(hsl)
    # 1 - |2 L - 1|, without the loss of small L
    swing = 2 * saturation * xp.minimum(lightness, 1 - lightness)
    return lightness + swing * (_hue_vector(xp, hue) - 0.5)


@overload
def rgb_to_hsv(rgb: Tensor) -> Tensor: ...
@overload
def rgb_to_hsv(rgb: ArrayLike) -> Floats: ...
def rgb_to_hsv(rgb: Any) -> Any:
    """Convert RGB to hue, saturation, value: V = max, S = (max - min) / max. Colors and V may exceed 1.

    Args:
        rgb: (..., 3), >= 0. Tensors are not checked: below 0 the result is finite but meaningless.

    Returns:
        (..., 3) hue in turns [0, 1), saturation in [0, 1], value. Gray and black as in `rgb_to_hsl`.

    Raises:
        ValueError: If the shape is wrong or an array has values that are not finite or negative.
    """
    xp, r, g, b = channels("rgb", rgb, (0.0,) * 3, (_INF,) * 3, "clip the colors below at 0")
    most, least = _largest_and_smallest(xp, r, g, b)
    return xp.concatenate([_hue(xp, r, g, b), _ratio(xp, most - least, most), most], -1)


@overload
def hsv_to_rgb(hsv: Tensor) -> Tensor: ...
@overload
def hsv_to_rgb(hsv: ArrayLike) -> Floats: ...
def hsv_to_rgb(hsv: Any) -> Any:
    """Convert HSV to RGB, the inverse of `rgb_to_hsv`: rgb = V (1 - S (1 - h(H))), h being `hue_vector`.

    Args:
        hsv: (..., 3) hue in turns, any finite number; saturation in [0, 1]; value >= 0. Unchecked in tensors.

    Returns:
        (..., 3), >= 0.

    Raises:
        ValueError: If the shape is wrong or an array has values that are not finite or out of their range.
    """
    xp, hue, saturation, value = _hsv(hsv)
    return value - value * saturation * (1 - _hue_vector(xp, hue))


@overload
def rgb_to_yuv(rgb: Tensor) -> Tensor: ...
@overload
def rgb_to_yuv(rgb: ArrayLike) -> Floats: ...
def rgb_to_yuv(rgb: Any) -> Any:
    """Convert RGB to luma and two color differences, linear in RGB, full range.

    Y = 0.299 R + 0.587 G + 0.114 B, U = (B - Y) / 1.772, V = (R - Y) / 1.402.

    Args:
        rgb: (..., 3), any finite numbers.

    Returns:
        (..., 3) Y, U, V; for colors in [0, 1] Y lies in [0, 1], U and V in [-1/2, 1/2], 0 for gray.

    Raises:
        ValueError: If the shape is wrong or an array has values that are not finite.

    References:
        ITU-R BT.601-7, section 2.5; U and V are its C_B and C_R before quantization, as in ITU-T T.871.
    """
    xp, r, g, b = channels("rgb", rgb, (-_INF,) * 3, (_INF,) * 3, "")
    # Differences to green: a gray of any value has U and V exactly 0.
    red = r - g
    blue = b - g
    above_green = _RED * red + _BLUE * blue
    u = (blue - above_green) / (2 - 2 * _BLUE)
    v = (red - above_green) / (2 - 2 * _RED)
    return xp.concatenate([g + above_green, u, v], -1)


@overload
def yuv_to_rgb(yuv: Tensor) -> Tensor: ...
@overload
def yuv_to_rgb(yuv: ArrayLike) -> Floats: ...
def yuv_to_rgb(yuv: Any) -> Any:
    """Convert YUV to RGB, the inverse of `rgb_to_yuv`.

    Args:
        yuv: (..., 3), any finite numbers.

    Returns:
        (..., 3) RGB; not every Y, U, V in range gives a color in range.

    Raises:
        ValueError: If the shape is wrong or an array has values that are not finite.
    """
    xp, y, u, v = channels("yuv", yuv, (-_INF,) * 3, (_INF,) * 3, "")
    red = (2 - 2 * _RED) * v
    blue = (2 - 2 * _BLUE) * u
    return xp.concatenate([y + red, y - (_RED * red + _BLUE * blue) / _GREEN, y + blue], -1)


@overload
def hue_vector(hue: Tensor) -> Tensor: ...
@overload
def hue_vector(hue: ArrayLike) -> Floats: ...
def hue_vector(hue: Any) -> Any:
    """Return h(H), the fully saturated color of a hue: the RGB of saturation 1 and lightness 1/2.

    Args:
        hue: (...) in turns, any finite number.

    Returns:
        (..., 3) in [0, 1], at least one channel 0 and one 1.

    Raises:
        ValueError: If a hue is not a number or, in an array, not finite.
    """
    xp, values = numbers("hue", hue)
    return _hue_vector(xp, values[..., None])


@overload
def rgb_by_hsl_saturation(hsl: Tensor) -> Tensor: ...
@overload
def rgb_by_hsl_saturation(hsl: ArrayLike) -> Floats: ...
def rgb_by_hsl_saturation(hsl: Any) -> Any:
    """Return (..., 3) derivatives of `hsl_to_rgb` by S: (1 - |2 L - 1|) (h(H) - 1/2). Arguments and errors as there."""
    xp, hue, _, lightness = _hsl(hsl)
    return 2 * xp.minimum(lightness, 1 - lightness) * (_hue_vector(xp, hue) - 0.5)


@overload
def rgb_by_hsl_lightness(hsl: Tensor) -> Tensor: ...
@overload
def rgb_by_hsl_lightness(hsl: ArrayLike) -> Floats: ...
def rgb_by_hsl_lightness(hsl: Any) -> Any:
    """Return (..., 3) derivatives of `hsl_to_rgb` by L: 1 + 2 S (h(H) - 1/2) below L = 1/2, 1 - 2 S (h(H) - 1/2) above.

    At L = 1/2 it is 1, the mean of the two. Arguments and errors as in `hsl_to_rgb`.
    """
    xp, hue, saturation, lightness = _hsl(hsl)
    return 1 + 2 * saturation * xp.sign(0.5 - lightness) * (_hue_vector(xp, hue) - 0.5)


@overload
def rgb_by_hsv_saturation(hsv: Tensor) -> Tensor: ...
@overload
def rgb_by_hsv_saturation(hsv: ArrayLike) -> Floats: ...
def rgb_by_hsv_saturation(hsv: Any) -> Any:
    """Return (..., 3) derivatives of `hsv_to_rgb` by S: V (h(H) - 1). Arguments and errors as there."""
    xp, hue, _, value = _hsv(hsv)
    return value * (_hue_vector(xp, hue) - 1)


@overload
def rgb_by_hsv_value(hsv: Tensor) -> Tensor: ...
@overload
def rgb_by_hsv_value(hsv: ArrayLike) -> Floats: ...
def rgb_by_hsv_value(hsv: Any) -> Any:
    """Return (..., 3) derivatives of `hsv_to_rgb` by V: 1 - S (1 - h(H)). Arguments and errors as there."""
    xp, hue, saturation, _ = _hsv(hsv)
    return 1 - saturation * (1 - _hue_vector(xp, hue))


@overload
def rgb_by_yuv_luma(yuv: Tensor) -> Tensor: ...
@overload
def rgb_by_yuv_luma(yuv: ArrayLike) -> Floats: ...
def rgb_by_yuv_luma(yuv: Any) -> Any:
    """Return (..., 3) derivatives of `yuv_to_rgb` by Y: 1 everywhere. Arguments and errors as there."""
    xp, *parts = channels("yuv", yuv, (-_INF,) * 3, (_INF,) * 3, "")
    return xp.concatenate([xp.ones_like(part) for part in parts], -1)


def _hue_vector(xp: Any, hue: Any) -> Any:
    """Return (..., 3) colors from hues (..., 1)."""
    sixths = 6 * (hue - xp.floor(hue))
    rgb = xp.concatenate([xp.abs(sixths - 3) - 1, 2 - xp.abs(sixths - 2), 2 - xp.abs(sixths - 4)], -1)
    return xp.clip(rgb, 0.0, 1.0)


def _largest_and_smallest(xp: Any, r: Any, g: Any, b: Any) -> tuple[Any, Any]:
    """Return the largest and the smallest of three channels."""
    return xp.maximum(xp.maximum(r, g), b), xp.minimum(xp.minimum(r, g), b)


def _ratio(xp: Any, part: Any, whole: Any) -> Any:
    """Return part over whole; 0 without gradient if the part is nearly 0, and 1 if it exceeds the whole."""
    something = part > 16 * xp.finfo(part.dtype).tiny
    divisor = xp.where(whole >= part, whole, part)  # differs from the whole only for colors out of range
    return xp.where(something, part / xp.where(something, divisor, xp.ones_like(part)), xp.zeros_like(part))


def _hue(xp: Any, r: Any, g: Any, b: Any) -> Any:
    """Return turns in [0, 1); 0 for gray."""
    by_red = (r >= g) & (r >= b)
    by_green = ~by_red & (g >= b)
    # One channel is the largest, even in a tie of two: hue has a gradient where the maximum itself has none.
    most = xp.where(by_red, r, xp.where(by_green, g, b))
    apart = most - xp.minimum(xp.minimum(r, g), b)
    after = xp.where(by_red, g - b, xp.where(by_green, b - r, r - g))
    start = xp.where(by_red, xp.zeros_like(r), xp.where(by_green, xp.full_like(r, 2.0), xp.full_like(r, 4.0)))
    colored = apart > 16 * xp.finfo(apart.dtype).tiny
    turns = (start + after / xp.where(colored, apart, xp.ones_like(apart))) / 6
    turns = turns - xp.floor(turns)
    turns = xp.where(turns < 1, turns, turns - 1)  # a negative value next to 0 is rounded up to 1
    return xp.where(colored, turns, xp.zeros_like(turns))
