"""Kernels that bound clusters, runs of neighboring rows of the splat table, and place them on the six faces.

Rows follow a Morton curve, so that a run of them is compact. Bounds are conservative: no member of a cluster reaches
a pixel outside its rectangle or lies nearer than its distance. World frame, scene units; faces as in `sphere.py`.
"""

from __future__ import annotations

import math

import numpy as np

from gsvis._kernels.compiled import inner, kernel, njit
from gsvis._kernels.threads import in_parts
from gsvis.hpr._kernels.reach import CLUSTER
from gsvis.hpr._kernels.sphere import CLAMP, DILATION, NEAR

_CHUNK = 256
_MARGIN = 1.0  # pixels; members are placed in float32
_SKEW = math.sqrt(1.0 + 2.0 * CLAMP * CLAMP)


@kernel
def bound_clusters(near, out, columns):
    """Write the bounds of each run of CLUSTER rows into out (B, 8) float32, and its rows as columns.

    Bounds are the least and the largest mean, the largest product of scale and reach, and the largest reach. `columns`
    is (B, 5, CLUSTER) float32: x, y and z of the mean, scale times reach, reach; NaN after the last row.
    """
    columns[:] = np.nan
    for b in range(len(out)):
        for k in range(3):
            out[b, k], out[b, 3 + k] = np.inf, -np.inf
        out[b, 6] = 0.0
        out[b, 7] = 0.0
        for i in range(b * CLUSTER, min((b + 1) * CLUSTER, len(near))):
            for k in range(3):
                out[b, k] = min(out[b, k], near[i, k])
                out[b, 3 + k] = max(out[b, 3 + k], near[i, k])
                columns[b, k, i - b * CLUSTER] = near[i, k]
            columns[b, 3, i - b * CLUSTER], columns[b, 4, i - b * CLUSTER] = near[i, 3] * near[i, 4], near[i, 4]
            out[b, 6] = max(out[b, 6], near[i, 3] * near[i, 4])
            out[b, 7] = max(out[b, 7], near[i, 4])


@inner
def _least_tangent(u, z_low, z_high):
    """Return the least tangent u / z for z between `z_low` and `z_high`."""
    return u / z_high if u >= 0.0 else u / z_low


@inner
def _first_pixel(place, size):
    """Return the pixel of a place on a face, clamped to 0..size."""
    return np.int16(min(max(math.floor(min(max(place, -1.0), size + 1.0)), 0), size))


@njit(cache=True)
def _place(z_low, z_high, u_low, u_high, v_low, v_high, reach, sigmas, size, out):
    """Write the rectangle of a cluster on a face into out (4,): first and last column, first and last row."""
    half = 0.5 * size
    out[0] = 1
    out[1] = 0
    out[2] = 1
    out[3] = 0
    if z_high <= NEAR:
        return
    nearest = max(max(u_low, -u_high), max(v_low, -v_high))
    blur = (sigmas * math.sqrt(DILATION) + 2.0 * _MARGIN) / half
    if nearest - _SKEW * reach > (1.0 + blur) * z_high:
        return
    z_low = max(z_low, NEAR)
    cu = min(max(-u_low, u_high) / z_low, CLAMP)
    cv = min(max(-v_low, v_high) / z_low, CLAMP)
    wide = reach * half / z_low
    radius = math.sqrt(wide * wide * (1.0 + cu * cu + cv * cv) + sigmas * sigmas * DILATION) + _MARGIN
    # Pixel k covers [k, k + 1).
    x_low = half * (1.0 + _least_tangent(u_low, z_low, z_high)) - radius
    x_high = half * (1.0 - _least_tangent(-u_high, z_low, z_high)) + radius
    y_low = half * (1.0 + _least_tangent(v_low, z_low, z_high)) - radius
    y_high = half * (1.0 - _least_tangent(-v_high, z_low, z_high)) + radius
    if x_high < 0.0 or y_high < 0.0 or x_low > size or y_low > size:
        return
    out[0], out[1] = _first_pixel(x_low, size), min(_first_pixel(x_high, size), size - 1)
    out[2], out[3] = _first_pixel(y_low, size), min(_first_pixel(y_high, size), size - 1)


@in_parts(lambda bounds, *_: (len(bounds) + _CHUNK - 1) // _CHUNK)
@kernel(error_model="numpy")
def place_clusters(begin, end, bounds, eye, size, nearest, rectangles):
    """Write a lower bound of the squared distance of each cluster's members, and its rectangle on each face.

    `nearest` (B,) is float32 and rounded like the distances of members. `rectangles` (6, B, 4) is int16: first and
    last column, first and last row; empty where no member reaches the face.
    """
    for chunk in range(begin, end):
        gaps = np.empty(3, np.float32)
        low = np.empty(3)
        high = np.empty(3)
        for b in range(_CHUNK * chunk, min(len(bounds), _CHUNK * chunk + _CHUNK)):
            for k in range(3):
                gaps[k] = max(max(bounds[b, k] - eye[k], eye[k] - bounds[b, 3 + k]), np.float32(0.0))
                low[k] = np.float64(bounds[b, k]) - np.float64(eye[k])
                high[k] = np.float64(bounds[b, 3 + k]) - np.float64(eye[k])
            nearest[b] = gaps[0] * gaps[0] + gaps[1] * gaps[1] + gaps[2] * gaps[2]
            reach = np.float64(bounds[b, 6])
            sigmas = np.float64(bounds[b, 7])
            for face in range(6):
                w = face >> 1
                u = 1 if w == 0 else 0
                v = 1 if w == 2 else 2
                z_low, z_high = (low[w], high[w]) if face & 1 == 0 else (-high[w], -low[w])
                _place(z_low, z_high, low[u], high[u], low[v], high[v], reach, sigmas, size, rectangles[face, b])


@kernel
def list_clusters(order, rectangles, lists, listed, counts):
    """Write the clusters that reach each face, in the given order, into lists (6, B); counts[face] of them.

    `listed` (6, B, 4) receives their rectangles.
    """
    for face in range(6):
        count = 0
        for k in range(len(order)):
            c = order[k]
            if rectangles[face, c, 0] <= rectangles[face, c, 1] and rectangles[face, c, 2] <= rectangles[face, c, 3]:
                lists[face, count] = c
                listed[face, count] = rectangles[face, c]
                count += 1
        counts[face] = count


@kernel
def mark_squares(rectangles, side, squares):
    """Mark the squares of `side` x `side` pixels that rectangles (6, B, 4) meet in squares (6, T, T)."""
    for face in range(6):
        for k in range(rectangles.shape[1]):
            place = rectangles[face, k]
            if place[0] > place[1] or place[2] > place[3]:
                continue
            for row in range(place[2] // side, place[3] // side + 1):
                for column in range(place[0] // side, place[1] // side + 1):
                    squares[face, row, column] = True
