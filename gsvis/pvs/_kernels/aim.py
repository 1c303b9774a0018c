"""Mark the directions in which an eye in a box can meet a Gaussian, on the six faces of a cube."""

from __future__ import annotations

import math

import numpy as np

from gsvis._kernels.compiled import inner, kernel

_WIDTH = 8  # children of a node
_TINY = 1e-12


@inner
def _tangents(low, high, z_low, z_high):
    """Return the least and the largest u / z over u in low..high and z in z_low..z_high, z_low > 0."""
    return (low / z_high if low >= 0.0 else low / z_low), (high / z_low if high >= 0.0 else high / z_high)


@inner
def _pixel(tangent, size):
    return min(max(math.floor(0.5 * size * (min(max(tangent, -2.0), 2.0) + 1.0)), -1), size)


@inner
def _cover(gap, face, size, place):
    """Write the rectangle of the vectors in a box gap (6,) on a face into place (4,); return whether it is empty."""
    w = face >> 1
    u = 1 if w == 0 else 0
    v = 1 if w == 2 else 2
    z_low, z_high = (gap[w], gap[3 + w]) if face & 1 == 0 else (-gap[3 + w], -gap[w])
    if z_high <= 0.0:
        return True
    z_low = max(z_low, _TINY)
    z_high = max(z_high, z_low)
    x_low, x_high = _tangents(gap[u], gap[3 + u], z_low, z_high)
    y_low, y_high = _tangents(gap[v], gap[3 + v], z_low, z_high)
    place[0], place[1] = max(_pixel(x_low, size), 0), min(_pixel(x_high, size), size - 1)
    place[2], place[3] = max(_pixel(y_low, size), 0), min(_pixel(y_high, size), size - 1)
    return place[0] > place[1] or place[2] > place[3]


@inner
def _is_marked(marked, face, place):
    """Return whether all pixels of a rectangle are marked."""
    for y in range(place[2], place[3] + 1):
        for x in range(place[0], place[1] + 1):
            if not marked[face, y, x]:
                return False
    return True


@inner
def _mark(marked, face, place):
    """Mark the pixels of a rectangle; return how many were not marked before."""
    count = 0
    for y in range(place[2], place[3] + 1):
        for x in range(place[0], place[1] + 1):
            count += not marked[face, y, x]
            marked[face, y, x] = True
    return count


@kernel(error_model="numpy")
def mark_centers(centers, eye, enough, marked):
    """Mark the pixels (6, S, S) in whose directions centers (P, 3) lie from an eye (3,), and the pixels around each.

    Once `enough` pixels are marked, no more are.
    """
    size = marked.shape[1]
    way = np.empty(3)
    count = 0
    for i in range(len(centers)):
        if count >= enough:
            break
        w = 0
        for axis in range(3):
            way[axis] = np.float64(centers[i, axis]) - eye[axis]
            if abs(way[axis]) > abs(way[w]):
                w = axis
        depth = abs(way[w])
        if depth == 0.0:
            continue
        face = 2 * w + (way[w] < 0.0)
        column = min(int((way[1 if w == 0 else 0] / depth + 1.0) * 0.5 * size), size - 1)
        line = min(int((way[1 if w == 2 else 2] / depth + 1.0) * 0.5 * size), size - 1)
        for y in range(max(line - 1, 0), min(line + 2, size)):
            for x in range(max(column - 1, 0), min(column + 2, size)):
                count += not marked[face, y, x]
                marked[face, y, x] = True


@kernel(error_model="numpy")
def mark_directions(boxes, children, low, high, enough, marked):
    """Mark the pixels in whose directions an eye between the corners low (3,) and high (3,) may meet a Gaussian.

    Args:
        boxes: (K, 6, 8) float32, of the hierarchy.
        children: (K, 8) int64, of the hierarchy.
        low: Lowest corner of the eyes.
        high: Highest corner.
        enough: Number of marked pixels from which no more are marked.
        marked: (6, S, S) bool, False; faces as in `hpr`.

    Returns:
        False if the eye may be inside the box of a Gaussian; then all directions can meet it, and nothing is marked.
    """
    size = marked.shape[1]
    stack = np.empty(1 + _WIDTH * 64, np.int64)
    gap = np.empty(6)
    place = np.empty(4, np.int64)
    stack[0] = 0
    waiting = 1
    count = 0
    while waiting > 0 and count < enough:
        waiting -= 1
        node = stack[waiting]
        for k in range(_WIDTH):
            if boxes[node, 0, k] == np.inf:
                continue
            within = True
            for axis in range(3):
                gap[axis] = np.float64(boxes[node, axis, k]) - high[axis]
                gap[3 + axis] = np.float64(boxes[node, 3 + axis, k]) - low[axis]
                within &= gap[axis] <= 0.0 <= gap[3 + axis]
            child = children[node, k]
            if within:
                if child < 0:
                    return False
                stack[waiting] = child
                waiting += 1
                continue
            fresh = False
            for face in range(6):
                if _cover(gap, face, size, place) or _is_marked(marked, face, place):
                    continue
                fresh = True
                if child < 0:
                    count += _mark(marked, face, place)
            if fresh and child >= 0:
                stack[waiting] = child
                waiting += 1
    return True
