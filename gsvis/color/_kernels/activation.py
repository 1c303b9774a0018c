"""Compute the contribution of each term for an eye, and find the terms that can matter for any eye in a box.

A term matters within a cap around its center, so a box needs no exponential. The directions from a box to a Gaussian
lie in a cone; the term can matter if cone and cap meet. Directions run from the eye to the Gaussian.
"""

from __future__ import annotations

import numpy as np

from gsvis._kernels.compiled import inner, kernel
from gsvis.color._kernels.rgb import to_rgb

__all__ = ["changes", "mark_terms", "responses"]

_SLACK = 2e-6  # tolerance of cosines, because centers are float32


@kernel
def responses(means, offsets, centers, decays, factors, eye, out):
    """Write `factors` (T,) times the value of each term's lobe, as the eye (3,) sees it, into out (T,)."""
    for i in range(len(offsets) - 1):
        first = offsets[i]
        last = offsets[i + 1]
        if first == last:
            continue
        x = means[i, 0] - eye[0]
        y = means[i, 1] - eye[1]
        z = means[i, 2] - eye[2]
        length = np.sqrt(x * x + y * y + z * z)
        if length == 0.0:  # an eye at the exact center looks along +z
            z = 1.0
            length = 1.0
        x = x / length
        y = y / length
        z = z / length
        for t in range(first, last):
            a = x - centers[t, 0]
            b = y - centers[t, 1]
            c = z - centers[t, 2]
            out[t] = factors[t] * np.exp(-0.5 * decays[t] * (a * a + b * b + c * c))


@kernel
def changes(space, base, scales, offsets, amplitudes, lobes, out):
    """Write the color change of a Gaussian without each of its terms, the largest over channels, into out (T,).

    Args:
        space: Code of `_kernels.rgb.SPACES`.
        base: (N, 3) base colors in that space.
        scales: (N,) factors that undo the scaling of RGB.
        offsets: (N + 1,) terms of each Gaussian.
        amplitudes: (T, 3) what a term adds where its lobe is 1.
        lobes: (T,) values of the lobes.
        out: (T,) written.
    """
    most = 0
    for i in range(len(base)):
        most = max(most, offsets[i + 1] - offsets[i])
    colors = np.empty((3, most + 1), np.float32)
    factors = np.empty(most + 1, np.float32)
    for i in range(len(base)):
        first = offsets[i]
        count = offsets[i + 1] - offsets[i]
        if count == 0:
            continue
        factors[: count + 1] = scales[i]
        for c in range(3):
            total = np.float64(base[i, c])
            for k in range(count):
                total += amplitudes[first + k, c] * lobes[first + k]
            colors[c, count] = total
            for k in range(count):
                colors[c, k] = total - amplitudes[first + k, c] * lobes[first + k]
        to_rgb(space, colors[:, : count + 1], factors[: count + 1])
        for k in range(count):
            largest = np.float32(0.0)
            for c in range(3):
                largest = max(largest, abs(colors[c, k] - colors[c, count]))
            out[first + k] = largest


@inner
def _cone(x, y, z, half_x, half_y, half_z):
    """Return the cosine of half the angle of a cone around (x, y, z) that holds the directions from a box to a point.

    The point lies at (x, y, z), of length > 0, from the middle of a box with these half sides. Cones below 90 degrees
    are convex, so a cone with the directions from all corners holds those from the whole box. At most 0: any direction.
    """
    length = x * x + y * y + z * z
    # squared cosine times squared length as a fraction: corners need no root, no division
    part = length
    whole = 1.0
    for corner in range(8):
        dx = x - half_x if corner & 1 else x + half_x
        dy = y - half_y if corner & 2 else y + half_y
        dz = z - half_z if corner & 4 else z + half_z
        along = x * dx + y * dy + z * dz
        if along <= 0.0:
            return 0.0
        square = dx * dx + dy * dy + dz * dz
        if along * along * whole < part * square:
            part = along * along
            whole = square
    return min(1.0, np.sqrt(part / (whole * length)))


@kernel
def mark_terms(ids, faint, means, offsets, centers, logs, widths, low, high, out):
    """Set out (T,) where a term of the Gaussians ids (V,) matters from somewhere in the box from low to high (3,).

    Args:
        ids: (V,) Gaussians.
        faint: (V,) minus the logarithm of the factor on each Gaussian's terms, or (0,) for no factor.
        means: (N, 3) centers.
        offsets: (N + 1,) terms of each Gaussian.
        centers: (T, 3) unit vectors.
        logs: (T,) logarithm of the largest contribution over the threshold.
        widths: (T,) 1 / decay.
        low: (3,) lowest corner.
        high: (3,) highest corner.
        out: (T,) bool; entries are set, never cleared.
    """
    middle_x = 0.5 * (low[0] + high[0])
    middle_y = 0.5 * (low[1] + high[1])
    middle_z = 0.5 * (low[2] + high[2])
    half_x = 0.5 * (high[0] - low[0])
    half_y = 0.5 * (high[1] - low[1])
    half_z = 0.5 * (high[2] - low[2])
    for j in range(len(ids)):
        i = ids[j]
        first = offsets[i]
        last = offsets[i + 1]
        if first == last:
            continue
        x = means[i, 0] - middle_x
        y = means[i, 1] - middle_y
        z = means[i, 2] - middle_z
        length = np.sqrt(x * x + y * y + z * z)
        cos_cone = _cone(x, y, z, half_x, half_y, half_z) if length > 0.0 else 0.0
        sin_cone = np.sqrt(max(0.0, 1.0 - cos_cone * cos_cone))
        if length > 0.0:
            x = x / length
            y = y / length
            z = z / length
        less = faint[j] if len(faint) else 0.0
        for t in range(first, last):
            left = logs[t] - less
            if not left > 0.0:
                continue
            cos_cap = 1.0 - left * widths[t]
            if cos_cone <= 0.0 or cos_cap <= -cos_cone + _SLACK:  # cone and cap together reach every direction
                out[t] = True
                continue
            sin_cap = np.sqrt(max(0.0, 1.0 - cos_cap * cos_cap))
            cosine = x * centers[t, 0] + y * centers[t, 1] + z * centers[t, 2]
            if cosine >= cos_cap * cos_cone - sin_cap * sin_cone - _SLACK:
                out[t] = True
