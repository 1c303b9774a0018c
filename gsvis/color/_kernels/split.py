"""Kernels that split the colors of Gaussians along directions into a base and the functions to fit.

Colors are (n, 3, D) RGB >= 0, with weights (n, D); a direction of weight 0 is ignored. Residuals carry the weight that
they have in RGB.
"""

from __future__ import annotations

import numpy as np

from gsvis._kernels.compiled import inner, kernel
from gsvis._kernels.threads import in_parts

__all__ = ["split_hsl", "split_linear"]


@inner
def _hue_chroma(r, g, b):
    """Return the hue in turns and the spread between the largest and the smallest component."""
    high = max(r, g, b)
    low = min(r, g, b)
    spread = high - low
    if spread <= 0.0:
        return 0.0, 0.0
    if high == r:
        hue = (g - b) / spread
    elif high == g:
        hue = (b - r) / spread + 2.0
    else:
        hue = (r - g) / spread + 4.0
    hue /= 6.0
    return hue - np.floor(hue), spread


@inner
def _pure(hue, shift):
    """Return a component of the fully saturated color of a hue; shift 5, 3, 1 for red, green, blue."""
    k = (shift + 6.0 * hue) % 6.0
    return 1.0 - max(0.0, min(k, 4.0 - k, 1.0))


@inner
def _largest(colors, weights):
    """Return the largest channel of the colors along directions of positive weight."""
    largest = np.float32(0.0)
    for c in range(3):
        for d in range(len(weights)):
            if weights[d] > 0.0:
                largest = max(largest, colors[c, d])
    return largest


@in_parts(lambda colors, *_: len(colors))
@kernel(error_model="numpy")
def split_linear(begin, end, colors, weights, base):
    """Write the weighted mean into base (n, 3), and subtract it from the colors."""
    for g in range(begin, end):
        total = 0.0
        for d in range(weights.shape[1]):
            total += weights[g, d]
        for c in range(3):
            s = 0.0
            for d in range(weights.shape[1]):
                s += np.float64(weights[g, d]) * colors[g, c, d]
            base[g, c] = s / total
            for d in range(weights.shape[1]):
                colors[g, c, d] -= base[g, c]


@in_parts(lambda colors, *_: len(colors))
@kernel(error_model="numpy")
def split_hsl(begin, end, colors, weights, scales, base, saturation, by_saturation, lightness, by_lightness):
    """Compute HSL of RGB / scale: bases (n, 3), S - S_ref and L - L_ref (n, D), weights of their RGB errors (n, D)."""
    for g in range(begin, end):
        largest = _largest(colors[g], weights[g])
        scale = np.float64(largest) if largest > 0.0 else 1.0
        scales[g] = scale
        east = 0.0
        north = 0.0
        for d in range(weights.shape[1]):
            saturation[g, d] = 0.0
            lightness[g, d] = 0.0
            if weights[g, d] <= 0.0:
                continue
            r = colors[g, 0, d] / scale
            green = colors[g, 1, d] / scale
            b = colors[g, 2, d] / scale
            hue, spread = _hue_chroma(r, green, b)
            light = 0.5 * (max(r, green, b) + min(r, green, b))
            room = 1.0 - abs(2.0 * light - 1.0)
            pure = min(spread / room, 1.0) if room > 1e-7 else 0.0
            saturation[g, d] = pure
            lightness[g, d] = light
            east += weights[g, d] * pure * np.cos(2.0 * np.pi * hue)
            north += weights[g, d] * pure * np.sin(2.0 * np.pi * hue)
        turn = np.arctan2(north, east) / (2.0 * np.pi)
        turn -= np.floor(turn)
        base[g, 0] = turn
        offsets = (_pure(turn, 5.0) - 0.5, _pure(turn, 3.0) - 0.5, _pure(turn, 1.0) - 0.5)
        squares = offsets[0] ** 2 + offsets[1] ** 2 + offsets[2] ** 2
        sums = np.zeros(4)
        for d in range(weights.shape[1]):
            pure = saturation[g, d]
            light = lightness[g, d]
            w = weights[g, d] * scale * scale
            room = 1.0 - abs(2.0 * light - 1.0)
            slope = -2.0 * np.sign(2.0 * light - 1.0) * pure
            by_saturation[g, d] = w * room * room * squares
            change = 0.0
            for offset in offsets:
                change += (1.0 + slope * offset) ** 2
            by_lightness[g, d] = w * change
            sums[0] += by_saturation[g, d]
            sums[1] += by_saturation[g, d] * pure
            sums[2] += by_lightness[g, d]
            sums[3] += by_lightness[g, d] * light
        base[g, 1] = sums[1] / sums[0] if sums[0] > 0.0 else 0.0
        base[g, 2] = sums[3] / sums[2] if sums[2] > 0.0 else 0.0
        for d in range(weights.shape[1]):
            saturation[g, d] -= base[g, 1]
            lightness[g, d] -= base[g, 2]
