"""Kernels that turn SH coefficients into colors from one eye. As at commit 70806c2.

Directions run from the eye to the Gaussian; color = max(0.5 + SH, 0).
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from gsvis.scene.sh import SH_C0, SH_C1, SH_C2, SH_C3

_BLOCK = 512
_FACTORS = (SH_C0, SH_C1, *SH_C2, *SH_C3)
_FACTORS_32 = tuple(np.float32(f) for f in _FACTORS)


@njit(cache=True, fastmath={"contract"})
def _band_1(x, y, z, f):
    return -f[1] * y, f[1] * z, -f[1] * x


@njit(cache=True, fastmath={"contract"})
def _band_2(x, y, z, f):
    xx, yy, zz = x * x, y * y, z * z
    return f[2] * x * y, f[3] * y * z, f[4] * (zz + zz - xx - yy), f[5] * x * z, f[6] * (xx - yy)


@njit(cache=True, fastmath={"contract"})
def _band_3(x, y, z, f):
    xx, yy, zz = x * x, y * y, z * z  # sums, not factors: an integer factor would widen float32
    xx3, yy3, zz2 = xx + xx + xx, yy + yy + yy, zz + zz
    around = zz2 + zz2 - xx - yy
    return (
        f[7] * y * (xx3 - yy), f[8] * x * y * z, f[9] * y * around, f[10] * z * (zz2 - xx3 - yy3),
        f[11] * x * around, f[12] * z * (xx - yy), f[13] * x * (xx - yy3),
    )  # fmt: skip


@njit(cache=True)
def _direction(x, y, z):
    """Unit vector along the offset from the eye, and the offset's length; +z for an eye at the very center."""
    length = np.sqrt(x * x + y * y + z * z)
    if length == 0.0:
        return 0.0, 0.0, 1.0, 1.0
    inverse = 1.0 / length
    return x * inverse, y * inverse, z * inverse, length


@njit(cache=True, fastmath={"contract"})
def _plus_band(color, band, higher, i, first):
    """Color plus the terms of one band, the coefficients of which start at higher[i, first]; the loop unrolls."""
    red, green, blue = color
    for k in range(len(band)):
        red += band[k] * higher[i, first + k, 0]
        green += band[k] * higher[i, first + k, 1]
        blue += band[k] * higher[i, first + k, 2]
    return red, green, blue


@njit(cache=True, fastmath={"contract"}, inline="always")  # a call would count references to the arrays each time
def _color(i, means, sh0, higher, degree, eye):
    """Red, green, blue of Gaussian i, unclipped: the direction in float64, the rest in float32."""
    f, half = _FACTORS_32, np.float32(0.5)
    color = half + f[0] * sh0[i, 0, 0], half + f[0] * sh0[i, 0, 1], half + f[0] * sh0[i, 0, 2]
    if degree == 0:
        return color
    x64, y64, z64, _ = _direction(means[i, 0] - eye[0], means[i, 1] - eye[1], means[i, 2] - eye[2])
    x, y, z = np.float32(x64), np.float32(y64), np.float32(z64)
    color = _plus_band(color, _band_1(x, y, z, f), higher, i, 0)
    if degree >= 2:
        color = _plus_band(color, _band_2(x, y, z, f), higher, i, 3)
    if degree >= 3:
        color = _plus_band(color, _band_3(x, y, z, f), higher, i, 8)
    return color


@njit(cache=True, parallel=True, nogil=True)
def colors_from_sh(ids, means, sh0, higher, degree, eye, lowest, features):
    """Colors of the Gaussians ids (M,), at least `lowest` (float32), into features[:, :3]; `higher` is shN."""
    for block in prange((len(ids) + _BLOCK - 1) // _BLOCK):
        for j in range(_BLOCK * block, min(len(ids), _BLOCK * (block + 1))):
            red, green, blue = _color(ids[j], means, sh0, higher, degree, eye)
            features[j, 0], features[j, 1], features[j, 2] = max(red, lowest), max(green, lowest), max(blue, lowest)
