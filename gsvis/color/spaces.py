"""Convert colors between RGB and HSL.

RGB values are those of a scene's colors (sRGB, 0 black, 1 white), channels last; hue is in turns. Every function takes
NumPy arrays (float64 stays, all else becomes float32) and returns NumPy arrays, or takes torch tensors and returns
tensors of their dtype on their device, with gradients that are finite everywhere. It knows no Gaussians.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis.color._kinds import channels

if TYPE_CHECKING:
    from torch import Tensor

__all__ = ["hsl_to_rgb", "rgb_to_hsl"]

Floats = NDArray[np.floating[Any]]

_INF = float("inf")
_SCALE = "divide the colors of each Gaussian by their largest value and keep that scale"


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
    most, least = _extremes(xp, r, g, b)
    lightness = (most + least) / 2
    room = xp.where(lightness <= 0.5, most + least, (1 - most) + (1 - least))
    return xp.concatenate([_hue(xp, r, g, b), _ratio(xp, most - least, room), lightness], -1)


@overload
def hsl_to_rgb(hsl: Tensor) -> Tensor: ...
@overload
def hsl_to_rgb(hsl: ArrayLike) -> Floats: ...
def hsl_to_rgb(hsl: Any) -> Any:
    """Convert HSL to RGB, the inverse of `rgb_to_hsl`.

    rgb = L + S (1 - |2 L - 1|) (h(H) - 1/2), h(H) being the color of a hue at saturation 1 and lightness 1/2.

    Args:
        hsl: (..., 3) hue in turns, any finite number; saturation and lightness in [0, 1], unchecked in tensors.

    Returns:
        (..., 3) in [0, 1].

    Raises:
        ValueError: If the shape is wrong or an array has values that are not finite or out of their range.
    """
    remedy = "clip saturation and lightness to [0, 1]"
    xp, hue, saturation, lightness = channels("hsl", hsl, (-_INF, 0.0, 0.0), (_INF, 1.0, 1.0), remedy)
    # 1 - |2 L - 1|, without the loss of small L
    swing = 2 * saturation * xp.minimum(lightness, 1 - lightness)
    return lightness + swing * (_hue_vector(xp, hue) - 0.5)


def _hue_vector(xp: Any, hue: Any) -> Any:
    """Return (..., 3) pure colors from hues (..., 1): at least one channel 0 and one 1."""
    sixths = 6 * (hue - xp.floor(hue))
    rgb = xp.concatenate([xp.abs(sixths - 3) - 1, 2 - xp.abs(sixths - 2), 2 - xp.abs(sixths - 4)], -1)
    return xp.clip(rgb, 0.0, 1.0)


def _extremes(xp: Any, r: Any, g: Any, b: Any) -> tuple[Any, Any]:
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
