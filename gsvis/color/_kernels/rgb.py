"""Kernels that convert colors of the spaces of `gsvis.color.variants` to RGB, many at a time and in place.

The formulas have no branches, so that loops vectorize. `tests/color/test_evaluate.py` compares them with those of
`gsvis.color.spaces`.
"""

from __future__ import annotations

import numpy as np

from gsvis._kernels.compiled import inner, njit

__all__ = ["SPACES", "to_rgb"]

SPACES = {"rgb": 0, "hsl": 1}
"""Codes of the spaces."""

_0, _1, _3, _4, _8, _9, _12 = (np.float32(k) for k in (0, 1, 3, 4, 8, 9, 12))


@inner(error_model="numpy")
def _hsl_channel(shift, hue, chroma, lightness):
    """Return one channel of RGB from HSL; shift 0, 8, 4 for red, green, blue."""
    k = shift + hue
    k -= _12 * np.floor(k / _12)
    return lightness - chroma * max(-_1, min(k - _3, _9 - k, _1))


@inner(error_model="numpy")
def _from_hsl(colors):
    """Convert HSL to RGB in place."""
    for j in range(colors.shape[1]):
        hue = _12 * (colors[0, j] - np.floor(colors[0, j]))
        saturation = min(max(colors[1, j], _0), _1)
        lightness = min(max(colors[2, j], _0), _1)
        chroma = saturation * min(lightness, _1 - lightness)
        colors[0, j] = _hsl_channel(_0, hue, chroma, lightness)
        colors[1, j] = _hsl_channel(_8, hue, chroma, lightness)
        colors[2, j] = _hsl_channel(_4, hue, chroma, lightness)


@njit(cache=True)
def to_rgb(space, colors, factors):
    """Convert colors (3, D) float32 to RGB in place; rescale by factors (D,); clip below 0."""
    if space == 1:
        _from_hsl(colors)
    for c in range(3):
        for j in range(colors.shape[1]):
            colors[c, j] = max(colors[c, j], _0)
        if space != 0:
            for j in range(colors.shape[1]):
                colors[c, j] *= factors[j]
