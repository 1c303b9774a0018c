"""Find what lies behind known depths on the six faces of a cube around an eye.

A face is S x S pixels that look along one axis of the world with a field of view of 90 degrees. World frame, scene
units; faces in the order +x, -x, +y, -y, +z, -z; on each, columns run along the first and rows along the second of the
other two axes.
"""

from __future__ import annotations

import math

import numpy as np

from gsvis._kernels.compiled import kernel, njit
from gsvis._kernels.threads import in_parts

NEAR = 0.01
DILATION = 0.3
CLAMP = 1.3  # bound of x/z and y/z in the Jacobian, as in the rasterizer for a field of view of 90 degrees
_CHUNK = 4096


@njit(cache=True)
def _span(w, u, radius, distance):
    """Return the least and largest tangent u / w over a sphere, seen along w; (1, -1) outside the field of view."""
    if radius >= distance:
        return -1.0, 1.0
    angle = math.atan2(u, w)
    spread = math.asin(radius / distance)
    if angle - spread >= 0.25 * math.pi or angle + spread <= -0.25 * math.pi:
        return 1.0, -1.0
    low = math.tan(max(angle - spread, -0.25 * math.pi))
    return low, math.tan(min(angle + spread, 0.25 * math.pi))


@in_parts(lambda near, *_: (len(near) + _CHUNK - 1) // _CHUNK)
@kernel(error_model="numpy")
def hidden_behind(begin, end, near, eye, pyramid, first_row, size, out):
    """Write whether the ball around each Gaussian lies fully behind the depths under its footprint into out (M,).

    `pyramid` (6, rows, S) stacks the levels of largest depths: level k, of side ceil(S / 2^k), begins at row
    first_row[k]. A ball that contains the eye is never hidden.
    """
    levels = len(first_row)
    for chunk in range(begin, end):
        rel = np.empty(3)
        for i in range(_CHUNK * chunk, min(len(near), _CHUNK * chunk + _CHUNK)):
            for k in range(3):
                rel[k] = near[i, k] - eye[k]
            radius = np.float64(near[i, 3]) * near[i, 4]
            nearest = math.sqrt(rel[0] ** 2 + rel[1] ** 2 + rel[2] ** 2) - radius
            hidden = nearest > 0.0
            for face in range(6):
                if not hidden:
                    break
                axis = face >> 1
                w = rel[axis]
                u = rel[1 if axis == 0 else 0]
                v = rel[1 if axis == 2 else 2]
                if face & 1:
                    w = -w
                u0, u1 = _span(w, u, radius, math.sqrt(w * w + u * u))
                v0, v1 = _span(w, v, radius, math.sqrt(w * w + v * v))
                if u0 > u1 or v0 > v1:
                    continue
                # One more pixel on each side, because light also passes between pixel centers.
                x0 = int(0.5 * size * (u0 + 1.0)) - 1
                x1 = int(0.5 * size * (u1 + 1.0)) + 1
                y0 = int(0.5 * size * (v0 + 1.0)) - 1
                y1 = int(0.5 * size * (v1 + 1.0)) + 1
                x0 = max(x0, 0)
                x1 = min(x1, size - 1)
                y0 = max(y0, 0)
                y1 = min(y1, size - 1)
                level = 0
                while level + 1 < levels and max((x1 >> level) - (x0 >> level), (y1 >> level) - (y0 >> level)) > 3:
                    level += 1
                for y in range(y0 >> level, (y1 >> level) + 1):
                    for x in range(x0 >> level, (x1 >> level) + 1):
                        hidden = hidden and pyramid[face, first_row[level] + y, x] < nearest
            out[i] = hidden
