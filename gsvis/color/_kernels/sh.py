"""Kernels that evaluate SH colors from one eye and propagate gradients back.

Directions run from the eye to the Gaussian; color = max(0.5 + SH, 0). The basis is that of `gsvis.scene.sh`, with
derivatives. `tests/color/test_sh_kernels.py` compares the two.
"""

from __future__ import annotations

import numpy as np

from gsvis._kernels.compiled import inner, kernel, njit
from gsvis._kernels.shared import share
from gsvis._kernels.threads import in_parts, on_numba_threads
from gsvis.scene.sh import SH_C0, SH_C1, SH_C2, SH_C3

_BLOCK = 512
_FACTORS = (SH_C0, SH_C1, *SH_C2, *SH_C3)
_FACTORS_32 = tuple(np.float32(f) for f in _FACTORS)


@njit(cache=True, fastmath={"contract"})
def _band_1(x, y, z, f):
    """Return the three harmonics of band 1, each times its factor in `f`."""
    return -f[1] * y, f[1] * z, -f[1] * x


@njit(cache=True, fastmath={"contract"})
def _band_2(x, y, z, f):
    """Return the five harmonics of band 2, each times its factor in `f`."""
    xx = x * x
    yy = y * y
    zz = z * z
    return f[2] * x * y, f[3] * y * z, f[4] * (zz + zz - xx - yy), f[5] * x * z, f[6] * (xx - yy)


@njit(cache=True, fastmath={"contract"})
def _band_3(x, y, z, f):
    """Return the seven harmonics of band 3, each times its factor in `f`."""
    # sums, not factors: an integer factor would widen float32
    xx = x * x
    yy = y * y
    zz = z * z
    xx3 = xx + xx + xx
    yy3 = yy + yy + yy
    zz2 = zz + zz
    around = zz2 + zz2 - xx - yy
    return (
        f[7] * y * (xx3 - yy),
        f[8] * x * y * z,
        f[9] * y * around,
        f[10] * z * (zz2 - xx3 - yy3),
        f[11] * x * around,
        f[12] * z * (xx - yy),
        f[13] * x * (xx - yy3),
    )


@njit(cache=True)
def basis(x, y, z, degree, out):
    """Write the SH basis at a unit vector into out (16,), in float64."""
    out[0] = SH_C0
    if degree >= 1:
        out[1], out[2], out[3] = _band_1(x, y, z, _FACTORS)
    if degree >= 2:
        out[4], out[5], out[6], out[7], out[8] = _band_2(x, y, z, _FACTORS)
    if degree >= 3:
        out[9], out[10], out[11], out[12], out[13], out[14], out[15] = _band_3(x, y, z, _FACTORS)


@njit(cache=True)
def basis_slopes(x, y, z, degree, out):
    """Write derivatives of the polynomials of `basis` by x, y, z into out (16, 3)."""
    out[:] = 0.0
    if degree < 1:
        return
    out[1, 1] = -SH_C1
    out[2, 2] = SH_C1
    out[3, 0] = -SH_C1
    if degree < 2:
        return
    out[4, 0], out[4, 1] = SH_C2[0] * y, SH_C2[0] * x
    out[5, 1], out[5, 2] = SH_C2[1] * z, SH_C2[1] * y
    out[6, 0], out[6, 1], out[6, 2] = -2 * SH_C2[2] * x, -2 * SH_C2[2] * y, 4 * SH_C2[2] * z
    out[7, 0], out[7, 2] = SH_C2[3] * z, SH_C2[3] * x
    out[8, 0], out[8, 1] = 2 * SH_C2[4] * x, -2 * SH_C2[4] * y
    if degree < 3:
        return
    xx = x * x
    yy = y * y
    zz = z * z
    out[9, 0], out[9, 1] = 6 * SH_C3[0] * x * y, 3 * SH_C3[0] * (xx - yy)
    out[10, 0], out[10, 1], out[10, 2] = SH_C3[1] * y * z, SH_C3[1] * x * z, SH_C3[1] * x * y
    out[11, 0], out[11, 1], out[11, 2] = -2 * SH_C3[2] * x * y, SH_C3[2] * (4 * zz - xx - 3 * yy), 8 * SH_C3[2] * y * z
    out[12, 0], out[12, 1] = -6 * SH_C3[3] * x * z, -6 * SH_C3[3] * y * z
    out[12, 2] = SH_C3[3] * (6 * zz - 3 * xx - 3 * yy)
    out[13, 0], out[13, 1], out[13, 2] = SH_C3[4] * (4 * zz - 3 * xx - yy), -2 * SH_C3[4] * x * y, 8 * SH_C3[4] * x * z
    out[14, 0], out[14, 1], out[14, 2] = 2 * SH_C3[5] * x * z, -2 * SH_C3[5] * y * z, SH_C3[5] * (xx - yy)
    out[15, 0], out[15, 1] = 3 * SH_C3[6] * (xx - yy), -6 * SH_C3[6] * x * y


@njit(cache=True)
def _direction(x, y, z):
    """Return the unit vector along the offset from the eye and the offset's length; +z for an eye at the center."""
    length = np.sqrt(x * x + y * y + z * z)
    if length == 0.0:
        return 0.0, 0.0, 1.0, 1.0
    inverse = 1.0 / length
    return x * inverse, y * inverse, z * inverse, length


@njit(cache=True, fastmath={"contract"})
def _plus_band(color, band, higher, i, first):
    """Return the color plus the terms of one band, whose coefficients start at higher[i, first]; the loop unrolls."""
    red, green, blue = color
    for k in range(len(band)):
        red += band[k] * higher[i, first + k, 0]
        green += band[k] * higher[i, first + k, 1]
        blue += band[k] * higher[i, first + k, 2]
    return red, green, blue


@njit(cache=True, fastmath={"contract"}, inline="always")  # a call would count references to the arrays each time
def _color(i, means, sh0, higher, degree, eye):
    """Return red, green, blue of Gaussian i, not clipped: the direction in float64, the rest in float32."""
    f = _FACTORS_32
    half = np.float32(0.5)
    color = half + f[0] * sh0[i, 0, 0], half + f[0] * sh0[i, 0, 1], half + f[0] * sh0[i, 0, 2]
    if degree == 0:
        return color
    x64, y64, z64, _ = _direction(means[i, 0] - eye[0], means[i, 1] - eye[1], means[i, 2] - eye[2])
    x = np.float32(x64)
    y = np.float32(y64)
    z = np.float32(z64)
    color = _plus_band(color, _band_1(x, y, z, f), higher, i, 0)
    if degree >= 2:
        color = _plus_band(color, _band_2(x, y, z, f), higher, i, 3)
    if degree >= 3:
        color = _plus_band(color, _band_3(x, y, z, f), higher, i, 8)
    return color


@inner
def _color_block(block, ids, means, sh0, higher, degree, eye, lowest, features):
    """Write the colors of one block of Gaussians; see `colors_from_sh`."""
    for j in range(_BLOCK * block, min(len(ids), _BLOCK * (block + 1))):
        red, green, blue = _color(ids[j], means, sh0, higher, degree, eye)
        features[j, 0], features[j, 1], features[j, 2] = max(red, lowest), max(green, lowest), max(blue, lowest)


@on_numba_threads
@kernel
def colors_from_sh(ids, means, sh0, higher, degree, eye, lowest, features):
    """Write colors of the Gaussians ids (M,), at least `lowest` (float32), into features[:, :3]; `higher` is shN."""
    share(_color_block, (len(ids) + _BLOCK - 1) // _BLOCK, (ids, means, sh0, higher, degree, eye, lowest, features))


@in_parts(lambda ids, *_: (len(ids) + _BLOCK - 1) // _BLOCK)
@kernel(error_model="numpy")
def colors_from_sh_backward(
    begin,
    end,
    ids,
    means,
    sh0,
    higher,
    degree,
    eye,
    features,
    v_features,
    v_sh0,
    v_higher,
    v_means,
):
    """Add gradients by sh0, shN and means (through the direction) into the last three arguments."""
    for block in range(begin, end):
        values = np.empty(16)
        slopes = np.zeros((16, 3))
        for j in range(_BLOCK * block, min(len(ids), _BLOCK * (block + 1))):
            i = ids[j]
            if degree == 0:  # color does not depend on direction
                for c in range(3):
                    if features[j, c] > 0.0:
                        v_sh0[i, 0, c] += v_features[j, c] * SH_C0
                continue
            x, y, z, length = _direction(means[i, 0] - eye[0], means[i, 1] - eye[1], means[i, 2] - eye[2])
            basis(x, y, z, degree, values)
            basis_slopes(x, y, z, degree, slopes)
            dx = 0.0
            dy = 0.0
            dz = 0.0
            for c in range(3):
                if features[j, c] <= 0.0:  # clipped
                    continue
                v = v_features[j, c]
                v_sh0[i, 0, c] += v * values[0]
                for k in range(1, (degree + 1) ** 2):
                    v_higher[i, k - 1, c] += v * values[k]
                    s = v * higher[i, k - 1, c]
                    dx += s * slopes[k, 0]
                    dy += s * slopes[k, 1]
                    dz += s * slopes[k, 2]
            along = dx * x + dy * y + dz * z  # the direction keeps its length
            v_means[i, 0] += (dx - along * x) / length
            v_means[i, 1] += (dy - along * y) / length
            v_means[i, 2] += (dz - along * z) / length
