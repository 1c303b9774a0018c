"""Kernels that evaluate the RGB of some Gaussians from one eye, and carry gradients back to bases and terms.

Arrays hold all N Gaussians and T terms; `rows` (M,) are the Gaussians of a view. Their S terms lie one after another
in what is written: those of rows[k] from starts[k] on. The exponent of a lobe comes from the chord, as in `srbf`.
"""

from __future__ import annotations

import math

import numpy as np

from gsvis._kernels.compiled import kernel
from gsvis._kernels.threads import in_parts

__all__ = ["KEPT", "gradients_of_rgb", "rgb_of_terms"]

KEPT = 5
"""What is kept of a term: its lobe, then sine and cosine of the polar angle, and of the azimuth, of its center."""


@in_parts(lambda rows, *_: len(rows))
@kernel(error_model="numpy")
def rgb_of_terms(
    begin, end, rows, starts, offsets, means, eye, base, centers, decays, growth, intensities, most, units, kept, colors
):
    """Write the colors of some Gaussians, not yet clipped at 0.

    Args:
        begin: First of the thread's part; the caller leaves it out.
        end: After the last of the part; the caller leaves it out.
        rows: (M,) int64.
        starts: (M + 1,) int64.
        offsets: (N + 1,) int64; the terms of Gaussian i are offsets[i]:offsets[i + 1].
        means: (N, 3) float32.
        eye: (3,) float64.
        base: (N, 3) float32.
        centers: (T, 2) float32, polar angle and azimuth.
        decays: (T,) float32.
        growth: (T, 1) float32, logarithm of what decays are multiplied with.
        intensities: (T, 3) float32.
        most: Largest decay.
        units: (M, 3) float32, written: directions from the eye, +z at a center.
        kept: (S, KEPT) float32, written.
        colors: (M, 3) float32, written.
    """
    half = np.float32(-0.5)
    most = np.float32(most)
    for k in range(begin, end):
        i = rows[k]
        x = means[i, 0] - eye[0]
        y = means[i, 1] - eye[1]
        z = means[i, 2] - eye[2]
        away = math.sqrt(x * x + y * y + z * z)
        here = away == 0.0
        scale = 1.0 / (1.0 if here else away)
        ux = np.float32(x * scale)
        uy = np.float32(y * scale)
        uz = np.float32(1.0 if here else z * scale)
        units[k, 0] = ux
        units[k, 1] = uy
        units[k, 2] = uz
        red = base[i, 0]
        green = base[i, 1]
        blue = base[i, 2]
        at = starts[k]
        for t in range(offsets[i], offsets[i + 1]):
            theta = centers[t, 0]
            phi = centers[t, 1]
            across = math.sin(theta)
            along = math.cos(theta)
            north = math.sin(phi)
            east = math.cos(phi)
            dx = ux - across * east
            dy = uy - across * north
            dz = uz - along
            decay = min(decays[t] * math.exp(growth[t, 0]), most)
            lobe = math.exp(half * decay * (dx * dx + dy * dy + dz * dz))
            red += lobe * intensities[t, 0]
            green += lobe * intensities[t, 1]
            blue += lobe * intensities[t, 2]
            kept[at, 0] = lobe
            kept[at, 1] = across
            kept[at, 2] = along
            kept[at, 3] = north
            kept[at, 4] = east
            at += 1
        colors[k, 0] = red
        colors[k, 1] = green
        colors[k, 2] = blue


@in_parts(lambda rows, *_: len(rows))
@kernel(error_model="numpy")
def gradients_of_rgb(
    begin, end, rows, starts, offsets, decays, growth, intensities, most, units, kept, by_colors, by_terms
):
    """Write the gradients of a loss by terms, from those by the colors of `rgb_of_terms`.

    Args:
        begin: First of the thread's part; the caller leaves it out.
        end: After the last of the part; the caller leaves it out.
        rows: (M,) int64.
        starts: (M + 1,) int64.
        offsets: (N + 1,) int64.
        decays: (T,) float32.
        growth: (T, 1) float32.
        intensities: (T, 3) float32.
        most: Largest decay; a decay that reaches it has no gradient.
        units: (M, 3) float32.
        kept: (S, KEPT) float32.
        by_colors: (M, 3) float32; what clipping holds back is 0.
        by_terms: Gradients by centers (S, 2), growth (S, 1) and intensities (S, 3), float32, written.
    """
    by_centers, by_growth, by_intensities = by_terms
    half = np.float32(-0.5)
    most = np.float32(most)
    for k in range(begin, end):
        i = rows[k]
        ux = units[k, 0]
        uy = units[k, 1]
        uz = units[k, 2]
        red = by_colors[k, 0]
        green = by_colors[k, 1]
        blue = by_colors[k, 2]
        at = starts[k]
        for t in range(offsets[i], offsets[i + 1]):
            lobe = kept[at, 0]
            across = kept[at, 1]
            along = kept[at, 2]
            north = kept[at, 3]
            east = kept[at, 4]
            dx = ux - across * east
            dy = uy - across * north
            dz = uz - along
            grown = decays[t] * math.exp(growth[t, 0])
            decay = min(grown, most)
            by_lobe = red * intensities[t, 0] + green * intensities[t, 1] + blue * intensities[t, 2]
            pull = by_lobe * lobe * decay
            by_centers[at, 0] = pull * (along * (east * dx + north * dy) - across * dz)
            by_centers[at, 1] = pull * across * (east * dy - north * dx)
            square = dx * dx + dy * dy + dz * dz
            by_growth[at, 0] = half * pull * square if grown < most else np.float32(0.0)
            by_intensities[at, 0] = red * lobe
            by_intensities[at, 1] = green * lobe
            by_intensities[at, 2] = blue * lobe
            at += 1
