"""Kernels that project Gaussians to the image, one at a time, in float64. As at commit 70806c2.

Per visible Gaussian, `splats` (M, 8) float64 holds its center (x, y) in pixels; A, B, C of log2 alpha = lo + A dx^2 +
B dx dy + C dy^2; lo = log2 opacity; and the half width and half height of the box where alpha >= 1/255.
Camera axes are OpenCV's. `intrinsics` is (fx, fy, cx, cy).

References:
    Zwicker et al., "EWA volume splatting", 2001; the Jacobian's clamp and the 0.3 px dilation follow 3DGS and gsplat.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

NEAR = 0.01
DILATION = 0.3
LOG2E = 1.4426950408889634
FUSED = {"contract"}  # multiply-adds in one rounding; nothing else is relaxed
_BLOCK = 2048
_MOST_REACH = 3.33  # sqrt(2 ln 255): where the most opaque Gaussian falls below 1/255


@njit(cache=True, fastmath=FUSED)
def _rotation(quat, r):
    """Rotation matrix of a quaternion of any length into r (3, 3)."""
    w, x, y, z = np.float64(quat[0]), np.float64(quat[1]), np.float64(quat[2]), np.float64(quat[3])
    s = 2.0 / (w * w + x * x + y * y + z * z)
    xx, yy, zz = s * x * x, s * y * y, s * z * z
    xy, xz, yz = s * x * y, s * x * z, s * y * z
    wx, wy, wz = s * w * x, s * w * y, s * w * z
    r[0, 0], r[0, 1], r[0, 2] = 1.0 - yy - zz, xy - wz, xz + wy
    r[1, 0], r[1, 1], r[1, 2] = xy + wz, 1.0 - xx - zz, yz - wx
    r[2, 0], r[2, 1], r[2, 2] = xz - wy, yz + wx, 1.0 - xx - yy


@njit(cache=True, fastmath=FUSED)
def _footprint(mean, quat, scale, viewmat, intrinsics, width, height, m, r):
    """Camera point, and m (2, 3) = J W R S, whose m m^T is the covariance in the image before dilation.

    The rotation is left in r (3, 3). Returns x, y, z and the clamped x / z, y / z.
    """
    fx, fy, cx, cy = intrinsics
    x = viewmat[0, 0] * mean[0] + viewmat[0, 1] * mean[1] + viewmat[0, 2] * mean[2] + viewmat[0, 3]
    y = viewmat[1, 0] * mean[0] + viewmat[1, 1] * mean[1] + viewmat[1, 2] * mean[2] + viewmat[1, 3]
    z = viewmat[2, 0] * mean[0] + viewmat[2, 1] * mean[1] + viewmat[2, 2] * mean[2] + viewmat[2, 3]
    if z <= NEAR:
        return x, y, z, 0.0, 0.0
    margin_x, margin_y = 0.15 * width / fx, 0.15 * height / fy
    u = min(max(x / z, -cx / fx - margin_x), (width - cx) / fx + margin_x)
    v = min(max(y / z, -cy / fy - margin_y), (height - cy) / fy + margin_y)
    _rotation(quat, r)
    jx, jy = fx / z, fy / z
    for k in range(3):  # the axes of the Gaussian, in the camera's frame
        s = np.float64(scale[k])
        a = s * (viewmat[0, 0] * r[0, k] + viewmat[0, 1] * r[1, k] + viewmat[0, 2] * r[2, k])
        b = s * (viewmat[1, 0] * r[0, k] + viewmat[1, 1] * r[1, k] + viewmat[1, 2] * r[2, k])
        c = s * (viewmat[2, 0] * r[0, k] + viewmat[2, 1] * r[1, k] + viewmat[2, 2] * r[2, k])
        m[0, k] = jx * (a - u * c)
        m[1, k] = jy * (b - v * c)
    return x, y, z, u, v


@njit(cache=True, fastmath=FUSED)
def _misses(mean, scale, viewmat, intrinsics, width, height):
    """Whether a bound on the footprint, without the rotation, already lies outside the image."""
    fx, fy, cx, cy = intrinsics
    z = viewmat[2, 0] * mean[0] + viewmat[2, 1] * mean[1] + viewmat[2, 2] * mean[2] + viewmat[2, 3]
    if z <= NEAR:
        return True
    u = (viewmat[0, 0] * mean[0] + viewmat[0, 1] * mean[1] + viewmat[0, 2] * mean[2] + viewmat[0, 3]) / z
    v = (viewmat[1, 0] * mean[0] + viewmat[1, 1] * mean[1] + viewmat[1, 2] * mean[2] + viewmat[1, 3]) / z
    size = _MOST_REACH * max(scale[0], max(scale[1], scale[2])) / z
    tan_x = max(cx, width - cx) / fx + 0.15 * width / fx  # where the Jacobian is clamped
    tan_y = max(cy, height - cy) / fy + 0.15 * height / fy
    half_x = fx * size * np.sqrt(1.0 + tan_x * tan_x) + _MOST_REACH
    half_y = fy * size * np.sqrt(1.0 + tan_y * tan_y) + _MOST_REACH
    x, y = fx * u + cx, fy * v + cy
    return x + half_x < 0.0 or x - half_x > width or y + half_y < 0.0 or y - half_y > height


@njit(cache=True, fastmath=FUSED)
def _covariance(m):
    """xx, xy, yy of m m^T, and its determinant without cancellation."""
    xx = m[0, 0] * m[0, 0] + m[0, 1] * m[0, 1] + m[0, 2] * m[0, 2]
    xy = m[0, 0] * m[1, 0] + m[0, 1] * m[1, 1] + m[0, 2] * m[1, 2]
    yy = m[1, 0] * m[1, 0] + m[1, 1] * m[1, 1] + m[1, 2] * m[1, 2]
    p = m[0, 1] * m[1, 2] - m[0, 2] * m[1, 1]
    q = m[0, 2] * m[1, 0] - m[0, 0] * m[1, 2]
    r = m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0]
    return xx, xy, yy, p * p + q * q + r * r


@njit(cache=True, parallel=True, nogil=True, fastmath=FUSED)
def project(
    means, quats, scales, opacities, viewmat, intrinsics, width, height, antialiased, ids, splats, depths, counts
):
    """Project all N Gaussians; block b keeps its visible ones at 2048 b, counts[b] of them."""
    fx, fy, cx, cy = intrinsics
    for block in prange(len(counts)):
        m, r = np.zeros((2, 3)), np.empty((3, 3))
        at = block * _BLOCK
        for i in range(block * _BLOCK, min(len(means), (block + 1) * _BLOCK)):
            if opacities[i] < np.float32(1.0 / 255.0):
                continue
            if _misses(means[i], scales[i], viewmat, intrinsics, width, height):
                continue
            x, y, z, _, _ = _footprint(means[i], quats[i], scales[i], viewmat, intrinsics, width, height, m, r)
            xx, xy, yy, det = _covariance(m)
            full = det + DILATION * (xx + yy) + DILATION * DILATION
            opacity = np.float64(opacities[i])
            if antialiased:
                opacity *= np.sqrt(det / full)
            if opacity * 255.0 < 1.0 or not full < np.inf:
                continue
            reach = np.sqrt(2.0 * np.log(255.0 * opacity)) * (1.0 + 1e-6)
            xx, yy = xx + DILATION, yy + DILATION
            half_x, half_y = reach * np.sqrt(xx), reach * np.sqrt(yy)
            u, v = fx * x / z + cx, fy * y / z + cy
            if u + half_x < 0.5 or u - half_x > width - 0.5 or v + half_y < 0.5 or v - half_y > height - 0.5:
                continue
            ids[at] = i
            splats[at, 0], splats[at, 1] = u, v
            splats[at, 2], splats[at, 3], splats[at, 4] = (
                -0.5 * LOG2E * yy / full,
                LOG2E * xy / full,
                -0.5 * LOG2E * xx / full,
            )
            splats[at, 5], splats[at, 6], splats[at, 7] = np.log2(opacity), half_x, half_y
            depths[at] = z
            at += 1
        counts[block] = at - block * _BLOCK


@njit(cache=True, parallel=True, nogil=True, fastmath=FUSED)
def gather_blocks(counts, starts, ids, splats, depths, out_ids, out_splats, out_depths):
    """Close the gaps that `project` leaves between blocks."""
    for block in prange(len(counts)):
        for k in range(counts[block]):
            source, target = block * _BLOCK + k, starts[block] + k
            out_ids[target], out_depths[target] = ids[source], depths[source]
            for c in range(8):
                out_splats[target, c] = splats[source, c]
