"""Kernels that project Gaussians to the image, and carry gradients back. One Gaussian at a time, float64.

Per visible Gaussian, `splats` (M, 8) float64 holds its center (x, y) in pixels; A, B, C of log2 alpha = lo + A dx^2 +
B dx dy + C dy^2; lo = log2 opacity; and the half width and half height of the box where alpha >= 1/255.
Camera axes are OpenCV's. `intrinsics` is (fx, fy, cx, cy).

References:
    Zwicker et al., "EWA volume splatting", 2001; the Jacobian's clamp and the 0.3 px dilation follow 3DGS and gsplat.
"""

from __future__ import annotations

import numpy as np

from gsvis._kernels.compiled import kernel, njit, uncounted
from gsvis._kernels.shared import take_next
from gsvis._kernels.threads import in_parts, in_threads

NEAR = 0.01
DILATION = 0.3
LOG2E = 1.4426950408889634
FUSED = {"contract"}  # multiply-adds in one rounding; nothing else is relaxed
_BLOCK = 2048
_MOST_REACH = 3.33  # sqrt(2 ln 255): where the most opaque Gaussian falls below 1/255


@njit(cache=True, fastmath=FUSED, inline="always")
def _rotation(i, quats, r):
    """Write the rotation matrix of quaternion i, of any length, into r (3, 3)."""
    w = np.float64(quats[i, 0])
    x = np.float64(quats[i, 1])
    y = np.float64(quats[i, 2])
    z = np.float64(quats[i, 3])
    s = 2.0 / (w * w + x * x + y * y + z * z)
    xx = s * x * x
    yy = s * y * y
    zz = s * z * z
    xy = s * x * y
    xz = s * x * z
    yz = s * y * z
    wx = s * w * x
    wy = s * w * y
    wz = s * w * z
    r[0, 0] = 1.0 - yy - zz
    r[0, 1] = xy - wz
    r[0, 2] = xz + wy
    r[1, 0] = xy + wz
    r[1, 1] = 1.0 - xx - zz
    r[1, 2] = yz - wx
    r[2, 0] = xz - wy
    r[2, 1] = yz + wx
    r[2, 2] = 1.0 - xx - yy


@njit(cache=True, fastmath=FUSED, inline="always")
def _footprint(i, means, quats, scales, viewmat, intrinsics, width, height, m, r):
    """Compute the camera point and m (2, 3) = J W R S; m m^T is the covariance in the image before dilation.

    The rotation is left in r (3, 3). Returns x, y, z and the clamped x / z, y / z.
    """
    fx, fy, cx, cy = intrinsics
    x = viewmat[0, 0] * means[i, 0] + viewmat[0, 1] * means[i, 1] + viewmat[0, 2] * means[i, 2] + viewmat[0, 3]
    y = viewmat[1, 0] * means[i, 0] + viewmat[1, 1] * means[i, 1] + viewmat[1, 2] * means[i, 2] + viewmat[1, 3]
    z = viewmat[2, 0] * means[i, 0] + viewmat[2, 1] * means[i, 1] + viewmat[2, 2] * means[i, 2] + viewmat[2, 3]
    if z <= NEAR:
        return x, y, z, 0.0, 0.0
    margin_x = 0.15 * width / fx
    margin_y = 0.15 * height / fy
    u = min(max(x / z, -cx / fx - margin_x), (width - cx) / fx + margin_x)
    v = min(max(y / z, -cy / fy - margin_y), (height - cy) / fy + margin_y)
    _rotation(i, quats, r)
    jx = fx / z
    jy = fy / z
    for k in range(3):  # the axes of the Gaussian, in the camera's frame
        s = np.float64(scales[i, k])
        a = s * (viewmat[0, 0] * r[0, k] + viewmat[0, 1] * r[1, k] + viewmat[0, 2] * r[2, k])
        b = s * (viewmat[1, 0] * r[0, k] + viewmat[1, 1] * r[1, k] + viewmat[1, 2] * r[2, k])
        c = s * (viewmat[2, 0] * r[0, k] + viewmat[2, 1] * r[1, k] + viewmat[2, 2] * r[2, k])
        m[0, k] = jx * (a - u * c)
        m[1, k] = jy * (b - v * c)
    return x, y, z, u, v


@uncounted(fastmath=FUSED)
def _find_candidates(means, scales, opacities, viewmat, intrinsics, width, height, first, last, out):
    """Write the indices of Gaussians first..last whose footprint may reach the image into out; return their number.

    The bound on the footprint leaves out the rotation. It is compared before the division by z, without a branch.
    """
    fx, fy, cx, cy = intrinsics
    tan_x = max(cx, width - cx) / fx + 0.15 * width / fx  # where the Jacobian is clamped
    tan_y = max(cy, height - cy) / fy + 0.15 * height / fy
    wide = _MOST_REACH * fx * np.sqrt(1.0 + tan_x * tan_x)
    high = _MOST_REACH * fy * np.sqrt(1.0 + tan_y * tan_y)
    least = np.float32(1.0 / 255.0)
    found = 0
    for i in range(first, last):
        p = np.float64(means[i, 0])
        q = np.float64(means[i, 1])
        r = np.float64(means[i, 2])
        z = viewmat[2, 0] * p + viewmat[2, 1] * q + viewmat[2, 2] * r + viewmat[2, 3]
        x = fx * (viewmat[0, 0] * p + viewmat[0, 1] * q + viewmat[0, 2] * r + viewmat[0, 3]) + cx * z
        y = fy * (viewmat[1, 0] * p + viewmat[1, 1] * q + viewmat[1, 2] * r + viewmat[1, 3]) + cy * z
        size = np.float64(max(scales[i, 0], max(scales[i, 1], scales[i, 2])))
        half_x = wide * size + _MOST_REACH * z
        half_y = high * size + _MOST_REACH * z
        missed = (opacities[i] < least) | (z <= NEAR) | (x + half_x < 0.0) | (x - half_x > width * z)
        missed = missed | (y + half_y < 0.0) | (y - half_y > height * z)
        out[found] = i
        found += not missed
    return found


@njit(cache=True, fastmath=FUSED, inline="always")
def _covariance(m):
    """Return xx, xy, yy of m m^T, and its determinant without cancellation."""
    xx = m[0, 0] * m[0, 0] + m[0, 1] * m[0, 1] + m[0, 2] * m[0, 2]
    xy = m[0, 0] * m[1, 0] + m[0, 1] * m[1, 1] + m[0, 2] * m[1, 2]
    yy = m[1, 0] * m[1, 0] + m[1, 1] * m[1, 1] + m[1, 2] * m[1, 2]
    p = m[0, 1] * m[1, 2] - m[0, 2] * m[1, 1]
    q = m[0, 2] * m[1, 0] - m[0, 0] * m[1, 2]
    r = m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0]
    return xx, xy, yy, p * p + q * q + r * r


@uncounted(fastmath=FUSED, error_model="numpy")
def _project_block(
    block, scene, viewmat, intrinsics, width, height, antialiased, ids, splats, depths, counts, candidates, m, r
):
    """Project the Gaussians of one block; see `project`. `candidates` (2048,), m (2, 3) and r (3, 3) are buffers."""
    means, quats, scales, opacities, shown = scene
    fx, fy, cx, cy = intrinsics
    at = block * _BLOCK
    last = min(len(means), (block + 1) * _BLOCK)
    found = _find_candidates(means, scales, opacities, viewmat, intrinsics, width, height, at, last, candidates)
    for k in range(found):
        i = candidates[k]
        if i < len(shown) and not shown[i]:
            continue
        x, y, z, _, _ = _footprint(i, means, quats, scales, viewmat, intrinsics, width, height, m, r)
        xx, xy, yy, det = _covariance(m)
        full = det + DILATION * (xx + yy) + DILATION * DILATION
        opacity = np.float64(opacities[i])
        if antialiased:
            opacity *= np.sqrt(det / full)
        if opacity * 255.0 < 1.0 or not full < np.inf:
            continue
        reach = np.sqrt(2.0 * np.log(255.0 * opacity)) * (1.0 + 1e-6)
        xx = xx + DILATION
        yy = yy + DILATION
        half_x = reach * np.sqrt(xx)
        half_y = reach * np.sqrt(yy)
        u = fx * x / z + cx
        v = fy * y / z + cy
        if u + half_x < 0.5 or u - half_x > width - 0.5 or v + half_y < 0.5 or v - half_y > height - 0.5:
            continue
        ids[at] = i
        splats[at, 0] = u
        splats[at, 1] = v
        splats[at, 2] = -0.5 * LOG2E * yy / full
        splats[at, 3] = LOG2E * xy / full
        splats[at, 4] = -0.5 * LOG2E * xx / full
        splats[at, 5] = np.log2(opacity)
        splats[at, 6] = half_x
        splats[at, 7] = half_y
        depths[at] = z
        at += 1
    counts[block] = at - block * _BLOCK


@in_threads(lambda *arguments: len(arguments[-1]))
@kernel(fastmath=FUSED, error_model="numpy")
def project(taken, scene, viewmat, intrinsics, width, height, antialiased, ids, splats, depths, counts):
    """Project all N Gaussians; block b keeps its visible ones at 2048 b, counts[b] of them.

    `scene` is means, quats, scales, opacities, and which of the first S Gaussians are drawn (S,); all others are.
    """
    m = np.zeros((2, 3))
    r = np.empty((3, 3))
    block = take_next(taken)
    candidates = np.empty(_BLOCK if block < len(counts) else 0, np.int64)
    while block < len(counts):
        _project_block(
            block, scene, viewmat, intrinsics, width, height, antialiased, ids, splats, depths, counts, candidates, m, r
        )
        block = take_next(taken)


@kernel
def close_gaps(counts, ids, splats, depths):
    """Close the gaps that `project` leaves between blocks, in place; return the number of splats.

    In place, because new memory costs more than the moves: a page of it is cleared by the system before it is written.
    """
    at = 0
    for block in range(len(counts)):
        first = block * _BLOCK
        for k in range(counts[block]):
            ids[at] = ids[first + k]
            depths[at] = depths[first + k]
            for c in range(8):
                splats[at, c] = splats[first + k, c]
            at += 1
    return at


@in_parts(lambda ids, *_: len(ids))
@kernel(error_model="numpy")
def write_by_centers(begin, end, ids, splats, sums, out):
    """Write the gradients of the first splats by their projected centers, those of `project_backward`, into out (N, 2).

    `ids` are their Gaussians, `sums` (M, 10) what `project_backward` gets.
    """
    for m in range(begin, end):
        a = splats[m, 2] * (2.0 / LOG2E)
        b = splats[m, 3] / LOG2E
        c = splats[m, 4] * (2.0 / LOG2E)
        i = ids[m]
        out[i, 0] = a * sums[m, 5] + b * sums[m, 6]
        out[i, 1] = b * sums[m, 5] + c * sums[m, 6]


@in_parts(lambda *arguments: (len(arguments[8]) + 255) // 256)
@kernel(fastmath=FUSED, error_model="numpy")
def project_backward(
    begin,
    end,
    means,
    quats,
    scales,
    opacities,
    viewmat,
    intrinsics,
    size,
    antialiased,
    ids,
    sums,
    v_means2d,
    v_opacities,
    outs,
):
    """Add the gradients of one view by means, quats, scales and opacities into outs, from the sums of the tiles.

    `sums` (M, 10) is what `blend_backward` returns, summed over tiles; `v_means2d` (M, 2) receives the gradient in the
    image, in loss per pixel.
    """
    given = means, quats, scales, opacities
    for block in range(begin, end):
        m = np.zeros((2, 3))
        r = np.empty((3, 3))
        v_r = np.empty((3, 3))
        _backward_block(
            block, given, viewmat, intrinsics, size, antialiased, ids, sums, v_means2d, v_opacities, outs, m, r, v_r
        )


@uncounted(fastmath=FUSED, error_model="numpy")
def _backward_block(
    block, given, viewmat, intrinsics, size, antialiased, ids, sums, v_means2d, v_opacities, outs, m, r, v_r
):
    """Run `project_backward` for the splats of one block; m (2, 3), r and v_r (3, 3) are buffers."""
    for j in range(256 * block, min(len(ids), 256 * block + 256)):
        _one_backward(
            ids[j], j, given, viewmat, intrinsics, size, antialiased, sums, v_means2d, v_opacities, outs, (m, r, v_r)
        )


@njit(cache=True, fastmath=FUSED, inline="always")
def _one_backward(i, j, given, viewmat, intrinsics, size, antialiased, sums, v_means2d, v_opacities, outs, buffers):
    """Run `project_backward` for Gaussian i, splat j; the buffers are (2, 3), (3, 3) and (3, 3)."""
    means, quats, scales, opacities = given
    v_means, v_quats, v_scales = outs
    m, r, v_r = buffers
    fx = intrinsics[0]
    fy = intrinsics[1]
    width, height = size
    x, y, z, u, v = _footprint(i, means, quats, scales, viewmat, intrinsics, width, height, m, r)
    xx, xy, yy, det = _covariance(m)
    full = det + DILATION * (xx + yy) + DILATION * DILATION
    xx = xx + DILATION
    yy = yy + DILATION
    a = yy / full
    b = -xy / full
    c = xx / full
    q = np.float64(sums[j, 4])
    qx = np.float64(sums[j, 5])
    qy = np.float64(sums[j, 6])
    # as a symmetric matrix
    g_a = -0.5 * sums[j, 7]
    g_b = -0.5 * sums[j, 8]
    g_c = -0.5 * sums[j, 9]
    v_u = -(a * qx + b * qy)
    v_v = -(b * qx + c * qy)
    v_means2d[j, 0] = v_u
    v_means2d[j, 1] = v_v
    # cov -> conic: dL/dcov = -conic G conic
    t00 = a * g_a + b * g_b
    t01 = a * g_b + b * g_c
    t10 = b * g_a + c * g_b
    t11 = b * g_b + c * g_c
    s_xx = -(t00 * a + t01 * b)
    s_xy = -(t00 * b + t01 * c)
    s_yy = -(t10 * b + t11 * c)
    opacity = np.float64(opacities[i])
    if antialiased:  # opacity * sqrt(det / full)
        shrink = np.sqrt(det / full)
        v_opacities[i] += q / opacity
        s_xx = s_xx - 0.5 * q * (yy / full)
        s_xy = s_xy + 0.5 * q * (xy / full)
        s_yy = s_yy - 0.5 * q * (xx / full)
        if shrink > 0.0:
            s_xx += 0.5 * q * (yy - DILATION) / det
            s_xy -= 0.5 * q * xy / det
            s_yy += 0.5 * q * (xx - DILATION) / det
    else:
        v_opacities[i] += q / opacity
    # m = J (W R S), J rows (fx / z)(1, 0, -u) and (fy / z)(0, 1, -v)
    v_x = fx / z * v_u
    v_y = fy / z * v_v
    v_z = np.float64(sums[j, 3])
    v_z -= fx * x / (z * z) * v_u + fy * y / (z * z) * v_v
    # by the clamped u and v inside J
    v_u_j = 0.0
    v_v_j = 0.0
    for k in range(3):
        s = np.float64(scales[i, k])
        n0 = 2.0 * (s_xx * m[0, k] + s_xy * m[1, k])
        n1 = 2.0 * (s_xy * m[0, k] + s_yy * m[1, k])
        v_z -= (n0 * m[0, k] + n1 * m[1, k]) / z
        axis_z = s * (viewmat[2, 0] * r[0, k] + viewmat[2, 1] * r[1, k] + viewmat[2, 2] * r[2, k])
        v_u_j -= n0 * fx / z * axis_z
        v_v_j -= n1 * fy / z * axis_z
        d0 = fx / z * n0
        d1 = fy / z * n1
        d2 = -(fx / z * u * n0 + fy / z * v * n1)
        v_scale = 0.0
        for e in range(3):
            by_axis = viewmat[0, e] * d0 + viewmat[1, e] * d1 + viewmat[2, e] * d2
            v_scale += by_axis * r[e, k]
            v_r[e, k] = by_axis * s
        v_scales[i, k] += v_scale
    if u == x / z:  # not clamped
        v_x += v_u_j / z
        v_z -= v_u_j * x / (z * z)
    if v == y / z:
        v_y += v_v_j / z
        v_z -= v_v_j * y / (z * z)
    for e in range(3):
        v_means[i, e] += viewmat[0, e] * v_x + viewmat[1, e] * v_y + viewmat[2, e] * v_z
    _add_quat_gradient(i, quats, v_r, v_quats)


@njit(cache=True, fastmath=FUSED, inline="always")
def _add_quat_gradient(i, quats, v_r, out):
    """Add the gradient by quaternion i, of any length, from the gradient by its rotation matrix."""
    w = np.float64(quats[i, 0])
    x = np.float64(quats[i, 1])
    y = np.float64(quats[i, 2])
    z = np.float64(quats[i, 3])
    n = np.sqrt(w * w + x * x + y * y + z * z)
    w = w / n
    x = x / n
    y = y / n
    z = z / n
    v_w = 2 * (x * (v_r[2, 1] - v_r[1, 2]) + y * (v_r[0, 2] - v_r[2, 0]) + z * (v_r[1, 0] - v_r[0, 1]))
    v_x = 2 * (
        -2 * x * (v_r[1, 1] + v_r[2, 2])
        + y * (v_r[0, 1] + v_r[1, 0])
        + z * (v_r[0, 2] + v_r[2, 0])
        + w * (v_r[2, 1] - v_r[1, 2])
    )
    v_y = 2 * (
        x * (v_r[0, 1] + v_r[1, 0])
        - 2 * y * (v_r[0, 0] + v_r[2, 2])
        + z * (v_r[1, 2] + v_r[2, 1])
        + w * (v_r[0, 2] - v_r[2, 0])
    )
    v_z = 2 * (
        x * (v_r[0, 2] + v_r[2, 0])
        + y * (v_r[1, 2] + v_r[2, 1])
        - 2 * z * (v_r[0, 0] + v_r[1, 1])
        + w * (v_r[1, 0] - v_r[0, 1])
    )
    along = v_w * w + v_x * x + v_y * y + v_z * z  # length has no effect
    out[i, 0] += (v_w - along * w) / n
    out[i, 1] += (v_x - along * x) / n
    out[i, 2] += (v_y - along * y) / n
    out[i, 3] += (v_z - along * z) / n
