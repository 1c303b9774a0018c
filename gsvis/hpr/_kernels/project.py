"""Project Gaussians onto a square of pixels of a face, many at once, for the splats of `splat.py`.

A table of `COLUMNS` Gaussians is a flat array, quantity by quantity: entry `k + QUANTITY` belongs to Gaussian k. So the
compiler sees that its parts do not overlap, and makes vectors of the loop. Faces as in `sphere.py`.
"""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from gsvis._kernels.compiled import uncounted
from gsvis.hpr._kernels.keys import STANDS, row_of
from gsvis.hpr._kernels.sphere import CLAMP, DILATION

__all__ = [
    "COLUMNS",
    "FAR",
    "FORMS",
    "PX",
    "PY",
    "ROOT",
    "ROWS",
    "TAKEN",
    "TOP",
    "X0",
    "X1",
    "Y0",
    "Y1",
    "B",
    "C",
    "gather",
    "project",
]

COLUMNS = 64
"""Gaussians that are projected together."""
_V, _Z, _SIGMAS, _STAND, _UU, _VV, _WW, _UV, _UW, _VW = (np.uint64(k * COLUMNS) for k in range(1, 11))
X0, X1, Y0, Y1, PX, PY, TAKEN, ROOT, FAR, TOP = (np.uint64(k * COLUMNS) for k in range(11, 21))
"""First and last column, first and last row, place of the center, share of the weight that is taken from the light,
root of the cover, distance, log2 of the opacity."""
ROWS = 21
"""Quantities of the table of float32."""
B = np.uint64(COLUMNS)
C = np.uint64(2 * COLUMNS)
"""The second and the third coefficient of the quadratic forms; the first begins at 0."""
FORMS = 3
"""Quantities of the table of float64."""
_LOG2_E = 1.4426950408889634
_ONE = np.float32(1.0)
_UPPER = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])  # entries of a covariance among the six that are kept

_numeric = partial(uncounted, error_model="numpy")


@uncounted
def gather(near, covars, eye, face, keys, first, count, given):
    """Write what `project` reads of the Gaussians of `count` keys, 64 at most, into columns of `given`."""
    axis = face >> 1
    au = 1 if axis == 0 else 0
    av = 1 if axis == 2 else 2
    sign = np.float32(1.0 - 2.0 * (face & 1))
    for k in range(np.uint64(count)):
        key = keys[np.uint64(first) + k]
        i = np.uint64(row_of(key))
        given[k] = near[i, au] - eye[au]
        given[k + _V] = near[i, av] - eye[av]
        given[k + _Z] = sign * (near[i, axis] - eye[axis])
        given[k + _SIGMAS] = near[i, 4]
        given[k + TOP] = near[i, 6]
        given[k + _STAND] = np.float32(1 << ((np.int64(key) >> np.int64(STANDS)) & 7))
        given[k + _UU] = covars[i, _UPPER[au, au]]
        given[k + _VV] = covars[i, _UPPER[av, av]]
        given[k + _WW] = covars[i, _UPPER[axis, axis]]
        given[k + _UV] = covars[i, _UPPER[au, av]]
        given[k + _UW] = covars[i, _UPPER[au, axis]]
        given[k + _VW] = covars[i, _UPPER[av, axis]]


@_numeric
def project(sign, corner, extent, half, given, forms):
    """Project the Gaussians in the columns of `given` onto a square: where they lie, and the conics of their splats.

    All 64 columns are computed, so that the loop becomes vectors.
    """
    clamp = np.float32(CLAMP)
    column = corner[0]
    line = corner[1]
    right = extent[0] - 1.0
    bottom = extent[1] - 1.0
    for k in range(np.uint64(COLUMNS)):
        du = given[k]
        dv = given[k + _V]
        z = given[k + _Z]
        inverse = _ONE / z
        tu = du * inverse
        tv = dv * inverse
        cu = min(max(tu, -clamp), clamp)
        cv = min(max(tv, -clamp), clamp)
        px = half * tu + half - column
        py = half * tv + half - line
        # entries of the Jacobian, world axes
        ju = half * inverse
        jv = -ju * cu * sign
        jw = -ju * cv * sign
        uu = given[k + _UU]
        vv = given[k + _VV]
        ww = given[k + _WW]
        uv = given[k + _UV]
        uw = given[k + _UW]
        vw = given[k + _VW]
        sharp_x = max(np.float64(ju * ju * uu + np.float32(2.0) * ju * jv * uw + jv * jv * ww), 0.0)
        sharp_y = max(np.float64(ju * ju * vv + np.float32(2.0) * ju * jw * vw + jw * jw * ww), 0.0)
        sxy = np.float64(ju * ju * uv + ju * jw * uw + jv * ju * vw + jv * jw * ww)
        sxx = sharp_x + DILATION
        syy = sharp_y + DILATION
        level = np.float64(given[k + _SIGMAS]) * given[k + _SIGMAS]
        # A thin splat far off the axis: rounding must not make its determinant 0.
        det = max(sxx * syy - sxy * sxy, DILATION * DILATION)
        cover = math.sqrt(min(max(sharp_x * sharp_y - sxy * sxy, 0.0) / det, 1.0))
        forms[k] = -0.5 * _LOG2_E * (syy / det)
        forms[k + B] = -_LOG2_E * (-sxy / det)
        forms[k + C] = -0.5 * _LOG2_E * (sxx / det)
        wide = math.sqrt(level * sxx)
        high = math.sqrt(level * syy)
        given[k + X0] = max(np.ceil(min(max(px - wide - 0.5, -1.0), 1e4)), 0.0)
        given[k + X1] = min(np.floor(min(max(px + wide - 0.5, -1.0), 1e4)), right)
        given[k + Y0] = max(np.ceil(min(max(py - high - 0.5, -1.0), 1e4)), 0.0)
        given[k + Y1] = min(np.floor(min(max(py + high - 0.5, -1.0), 1e4)), bottom)
        given[k + PX] = px
        given[k + PY] = py
        given[k + TAKEN] = min(given[k + _STAND] * np.float32(cover), _ONE)
        given[k + ROOT] = math.sqrt(cover)
        given[k + FAR] = math.sqrt(du * du + dv * dv + z * z)
