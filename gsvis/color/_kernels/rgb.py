"""Kernels that turn colours of the spaces of `gsvis.color.variants` into RGB, many at a time and in place.

The formulas have no branches, so that loops over them become vectors. `tests/color/test_evaluate.py` holds them to
those of `gsvis.color.spaces`.
"""

from __future__ import annotations

import numpy as np
from numba import njit

__all__ = ["SPACES", "to_rgb"]

SPACES = {"rgb": 0, "hsl": 1, "hsv": 2, "yuv": 3}
"""Codes of the spaces."""

_0, _1, _3, _4, _5, _6, _8, _9, _12 = (np.float32(k) for k in (0, 1, 3, 4, 5, 6, 8, 9, 12))
_V_RED, _U_BLUE = np.float32(1.402), np.float32(1.772)
_GREEN_RED, _GREEN_BLUE = np.float32(0.299 / 0.587), np.float32(0.114 / 0.587)


@njit(cache=True, error_model="numpy")
def _hsl_channel(shift, hue, chroma, lightness):
    k = shift + hue
    k -= _12 * np.floor(k / _12)
    return lightness - chroma * max(-_1, min(k - _3, _9 - k, _1))


@njit(cache=True, error_model="numpy")
def _hsv_channel(shift, hue, chroma, value):
    k = shift + hue
    k -= _6 * np.floor(k / _6)
    return value - chroma * max(_0, min(k, _4 - k, _1))


@njit(cache=True, error_model="numpy")
def _from_hsl(colours):
    for j in range(colours.shape[1]):
        hue = _12 * (colours[0, j] - np.floor(colours[0, j]))
        saturation = min(max(colours[1, j], _0), _1)
        lightness = min(max(colours[2, j], _0), _1)
        chroma = saturation * min(lightness, _1 - lightness)
        colours[0, j] = _hsl_channel(_0, hue, chroma, lightness)
        colours[1, j] = _hsl_channel(_8, hue, chroma, lightness)
        colours[2, j] = _hsl_channel(_4, hue, chroma, lightness)


@njit(cache=True, error_model="numpy")
def _from_hsv(colours):
    for j in range(colours.shape[1]):
        hue = _6 * (colours[0, j] - np.floor(colours[0, j]))
        saturation = min(max(colours[1, j], _0), _1)
        value = min(max(colours[2, j], _0), _1)
        chroma = saturation * value
        colours[0, j] = _hsv_channel(_5, hue, chroma, value)
        colours[1, j] = _hsv_channel(_3, hue, chroma, value)
        colours[2, j] = _hsv_channel(_1, hue, chroma, value)


@njit(cache=True)
def _from_yuv(colours):
    for j in range(colours.shape[1]):
        y, u, v = colours[0, j], colours[1, j], colours[2, j]
        red, blue = _V_RED * v, _U_BLUE * u
        colours[0, j] = y + red
        colours[1, j] = y - _GREEN_RED * red - _GREEN_BLUE * blue
        colours[2, j] = y + blue


@njit(cache=True)
def to_rgb(space, colours, factors):
    """RGB of colours (3, D) float32, in place; brought back to scale by factors (D,); nothing below 0 is left."""
    if space == 1:
        _from_hsl(colours)
    elif space == 2:
        _from_hsv(colours)
    elif space == 3:
        _from_yuv(colours)
    for c in range(3):
        for j in range(colours.shape[1]):
            colours[c, j] = max(colours[c, j], _0)
        if space != 0:
            for j in range(colours.shape[1]):
                colours[c, j] *= factors[j]
