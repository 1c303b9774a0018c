"""Kernels of the occlusion hull: the shape of Gaussians seen from an eye, and the depth at which light is spent.

All arrays are checked and contiguous; world frame, relative to the eye, scene units. Cells are those of `hull.py`.
"""

from __future__ import annotations

import numpy as np

from gsvis._kernels.compiled import kernel, njit
from gsvis._kernels.threads import in_parts
from gsvis.hpr._kernels.hull import cell_of, direction_of, direction_on_face

_WIDE = 0.25  # standard deviation over distance above which a Gaussian counts as wide
_LEAST_ALPHA = 1.0 / 64.0


@njit(cache=True, inline="always")
def _whitening(quats, scales, i):
    """Return the rows of diag(1/scales) R^T of Gaussian i: nine numbers."""
    w = quats[i, 0]
    x = quats[i, 1]
    y = quats[i, 2]
    z = quats[i, 3]
    a = 1.0 / scales[i, 0]
    b = 1.0 / scales[i, 1]
    c = 1.0 / scales[i, 2]
    return (
        a * (1 - 2 * (y * y + z * z)),
        a * 2 * (x * y + w * z),
        a * 2 * (x * z - w * y),
        b * 2 * (x * y - w * z),
        b * (1 - 2 * (x * x + z * z)),
        b * 2 * (y * z + w * x),
        c * 2 * (x * z + w * y),
        c * 2 * (y * z - w * x),
        c * (1 - 2 * (x * x + y * y)),
    )


@in_parts(lambda means, *_: len(means))
@kernel(error_model="numpy")
def shapes_from_eye(begin, end, means, quats, scales, opacities, min_alpha, eye, toward, faces, out):
    """Compute the shape of each Gaussian from the eye: relative centers in toward (N, 3), and a row of out (N, 5).

    Its face of the cubemap goes into faces (N,): 6 for Gaussians so wide that they lie on many, 7 for those too faint
    to be visible.

    The row is: distance of the center, distance of the nearest point where alpha reaches min_alpha in that direction (0
    if the eye is inside), largest angle between the center and the ring of one standard deviation, solid angle times
    opacity of the whole Gaussian, and squared distance of the eye in standard deviations.
    """
    for i in range(begin, end):
        x = means[i, 0] - eye[0]
        y = means[i, 1] - eye[1]
        z = means[i, 2] - eye[2]
        toward[i, 0] = x
        toward[i, 1] = y
        toward[i, 2] = z
        far = np.sqrt(x * x + y * y + z * z)
        m = _whitening(quats, scales, i)
        p = m[0] * x + m[1] * y + m[2] * z
        q = m[3] * x + m[4] * y + m[5] * z
        r = m[6] * x + m[7] * y + m[8] * z
        squared = p * p + q * q + r * r
        reach = 2.0 * np.log(max(opacities[i] / min_alpha, 1.0))
        s = scales[i]
        largest = np.float64(max(s[0], s[1], s[2]))
        out[i, 0] = far
        out[i, 4] = squared
        faces[i] = 7 if opacities[i] < min_alpha else 6
        if squared <= reach or far == 0.0:
            out[i, 1], out[i, 2], out[i, 3] = 0.0, np.pi, 4.0 * np.pi * opacities[i]
            continue
        # Extent toward the eye: sqrt(d^T covariance d), from the whitened unit direction times squared scales.
        u = p * s[0] * s[0] / far
        v = q * s[1] * s[1] / far
        w = r * s[2] * s[2] / far
        out[i, 1] = max(far - np.sqrt(reach * (u * u + v * v + w * w)), 0.0)
        out[i, 2] = largest / far
        if faces[i] == 6 and out[i, 2] <= _WIDE:
            faces[i] = cell_of(x, y, z, 1)
        area = np.float64(s[0]) * s[1] * s[2] * np.sqrt(squared) / far  # sigma times sigma of the shadow along the ray
        out[i, 3] = 2.0 * np.pi * area / (far * far) * opacities[i]


@njit(cache=True, inline="always")
def _deposit(thickness, cell, depth, alpha, nearest, steps_per_log):
    """Add -log(1 - alpha) of optical thickness at a depth to the histogram of a cell.

    Bin 0 is the eye itself, bin 1 ends at `nearest`; equal steps of log depth follow; the last bin has no end.
    """
    bins = thickness.shape[1]
    k = 0 if depth <= 0.0 else 1
    if depth > nearest:
        k = min(int(np.log(depth / nearest) * steps_per_log) + 2, bins - 1)
    thickness[cell, k] -= np.log(1.0 - min(alpha, 0.999))


@in_parts(lambda *_: 6)
@kernel(error_model="numpy")
def thicken(
    begin,
    end,
    toward,
    quats,
    scales,
    opacities,
    shapes,
    order,
    begins,
    size,
    nearest,
    steps_per_log,
    thickness,
):
    """Add the optical thickness of Gaussians in each cell and at each depth to thickness (6 size^2, bins).

    Small ones are spread over their cell. Larger ones are evaluated at the centers of cells of their face where their
    alpha is above 1/64, very wide ones at the centers of blocks of 4 x 4 cells of all faces. `order` and `begins` list
    the Gaussians of each face, then the wide ones. One thread works on one face.
    """
    cell_angle = 2.0 / size
    for face in range(begin, end):
        own = begins[face + 1] - begins[face]
        count = begins[face + 1] - begins[face] + begins[7] - begins[6]
        for k in range(count):
            wide = k >= own
            i = order[begins[6] + k - own] if wide else order[begins[face] + k]
            x = toward[i, 0]
            y = toward[i, 1]
            z = toward[i, 2]
            spread = shapes[i, 2]
            if not wide and spread < 0.5 * cell_angle:
                u, v = _place_on_face(x, y, z, face)
                solid = cell_angle * cell_angle / (1.0 + u * u + v * v) ** 1.5
                alpha = min(shapes[i, 3] / solid, opacities[i])
                _deposit(thickness, cell_of(x, y, z, size), shapes[i, 0], alpha, nearest, steps_per_log)
                continue
            if opacities[i] <= _LEAST_ALPHA:
                continue
            m = _whitening(quats, scales, i)
            p = m[0] * x + m[1] * y + m[2] * z
            q = m[3] * x + m[4] * y + m[5] * z
            r = m[6] * x + m[7] * y + m[8] * z
            low_row = 0
            high_row = size
            low_column = 0
            high_column = size
            step = 4
            reach = 2.0 * np.log(opacities[i] / _LEAST_ALPHA)
            if not wide:
                u, v = _place_on_face(x, y, z, face)
                half = np.sqrt(reach) * spread * (1.0 + u * u + v * v)
                low_column = max(int((u - half + 1.0) * 0.5 * size), 0)
                high_column = min(int((u + half + 1.0) * 0.5 * size) + 1, size)
                low_row = max(int((v - half + 1.0) * 0.5 * size), 0)
                high_row = min(int((v + half + 1.0) * 0.5 * size) + 1, size)
                step = 1
            inside = shapes[i, 4] <= reach
            for row in range(low_row, high_row, step):
                for column in range(low_column, high_column, step):
                    u = (column + 0.5 * step) * cell_angle - 1.0
                    v = (row + 0.5 * step) * cell_angle - 1.0
                    dx, dy, dz = direction_on_face(face, u, v)
                    a = m[0] * dx + m[1] * dy + m[2] * dz
                    b = m[3] * dx + m[4] * dy + m[5] * dz
                    c = m[6] * dx + m[7] * dy + m[8] * dz
                    along = a * p + b * q + c * r
                    length = a * a + b * b + c * c
                    squared = shapes[i, 4]
                    depth = 0.0
                    if along > 0.0:
                        # a product, not a difference of squares
                        e = q * c - r * b
                        h = r * a - p * c
                        k = p * b - q * a
                        squared = (e * e + h * h + k * k) / length
                        depth = along / length * np.sqrt(dx * dx + dy * dy + dz * dz)
                    elif not inside:
                        continue
                    if squared > reach:
                        continue
                    alpha = opacities[i] * np.exp(-0.5 * squared)
                    for rr in range(row, min(row + step, size)):
                        for cc in range(column, min(column + step, size)):
                            cell = (face * size + rr) * size + cc
                            _deposit(thickness, cell, depth, alpha, nearest, steps_per_log)


@njit(cache=True, inline="always")
def _place_on_face(x, y, z, face):
    """Return the place (u, v) of a direction on a face."""
    if face < 2:
        return y / abs(x), z / abs(x)
    if face < 4:
        return x / abs(y), z / abs(y)
    return x / abs(z), y / abs(z)


@in_parts(lambda thickness, *_: len(thickness))
@kernel(error_model="numpy")
def find_spent_depths(begin, end, thickness, limit, nearest, steps_per_log, out):
    """Write the far end of the bin in which each cell's summed thickness reaches the limit into out (cells,).

    0 if it does at the eye itself, infinite if it does not before the last bin, which has no end.
    """
    for cell in range(begin, end):
        total = 0.0
        out[cell] = np.inf
        for k in range(thickness.shape[1] - 1):
            total += thickness[cell, k]
            if total >= limit:
                out[cell] = 0.0 if k == 0 else nearest * np.exp((k - 1) / steps_per_log)
                break


@in_parts(lambda size, out: len(out))
@kernel(error_model="numpy")
def centers_of_cells(begin, end, size, out):
    """Write unit directions of the centers of all cells into out (6 size^2, 3)."""
    for cell in range(begin, end):
        x, y, z = direction_of(cell, size)
        length = np.sqrt(x * x + y * y + z * z)
        out[cell, 0] = x / length
        out[cell, 1] = y / length
        out[cell, 2] = z / length


@njit(cache=True, inline="always")
def _deepest_near(depths, x, y, z, size):
    """Return the largest depth of the up to four cells whose centers surround a direction; skips other faces."""
    ax = abs(x)
    ay = abs(y)
    az = abs(z)
    face = cell_of(x, y, z, 1)
    u, v = _place_on_face(x, y, z, face) if max(ax, ay, az) > 0.0 else (0.0, 0.0)
    column = int(np.floor((u + 1.0) * 0.5 * size - 0.5))
    row = int(np.floor((v + 1.0) * 0.5 * size - 0.5))
    best = 0.0
    for rr in range(max(row, 0), min(row + 2, size)):
        for cc in range(max(column, 0), min(column + 2, size)):
            best = max(best, depths[(face * size + rr) * size + cc])
    return best


@in_parts(lambda toward, *_: len(toward))
@kernel(error_model="numpy")
def nearness(begin, end, toward, quats, scales, opacities, shapes, min_alpha, depths, size, out):
    """Write each Gaussian's least distance, divided by the depth to which the eye sees there, into out (N,).

    Tests the direction of the center and, for Gaussians larger than half a cell, of the six ends of the one-sigma
    ellipsoid. 0 if the eye is inside, infinite if the Gaussian is too faint to be visible.
    """
    for i in range(begin, end):
        if opacities[i] < min_alpha:
            out[i] = np.inf
            continue
        if shapes[i, 1] <= 0.0:
            out[i] = 0.0
            continue
        x = toward[i, 0]
        y = toward[i, 1]
        z = toward[i, 2]
        depth = _deepest_near(depths, x, y, z, size)
        if shapes[i, 2] > 1.0 / size:
            m = _whitening(quats, scales, i)
            for axis in range(3):
                s = np.float64(scales[i, axis])
                dx = m[3 * axis] * s * s
                dy = m[3 * axis + 1] * s * s
                dz = m[3 * axis + 2] * s * s
                for sign in (-1.0, 1.0):
                    depth = max(depth, _deepest_near(depths, x + sign * dx, y + sign * dy, z + sign * dz, size))
        out[i] = shapes[i, 1] / depth if depth > 0.0 else np.inf
