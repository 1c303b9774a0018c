"""Kernels that project Gaussians to the image, and carry gradients back. Float64.

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
from gsvis.render._kernels.lanes import LOG2_255

NEAR = 0.01
DILATION = 0.3
LOG2E = 1.4426950408889634
FUSED = {"contract"}  # multiply-adds in one rounding; nothing else is relaxed
BLOCK = 2048  # Gaussians that one thread takes at a time
_ROWS = 11  # numbers of a Gaussian: mean, scales, quaternion, opacity
_ROOT_HALF = 0x3FE6A09E667F3BCD  # the bits of the root of 1/2
_MOST_REACH = 3.33  # sqrt(2 ln 255): where the most opaque Gaussian falls below 1/255


@njit(cache=True, fastmath=FUSED, inline="always")
def _rotation(w, x, y, z):
    """Return the rows of the rotation matrix of a quaternion of any length, one behind the other."""
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
    return 1.0 - yy - zz, xy - wz, xz + wy, xy + wz, 1.0 - xx - zz, yz - wx, xz - wy, yz + wx, 1.0 - xx - yy


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
    quat = np.float64(quats[i, 0]), np.float64(quats[i, 1]), np.float64(quats[i, 2]), np.float64(quats[i, 3])
    rotation = _rotation(quat[0], quat[1], quat[2], quat[3])
    for k in range(3):
        r[k, 0] = rotation[3 * k]
        r[k, 1] = rotation[3 * k + 1]
        r[k, 2] = rotation[3 * k + 2]
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
def _find_in_block(block, scene, viewmat, intrinsics, width, height, found):
    """Write the candidates of one block from its place on; return their number. See `find_candidates`.

    The bound on the footprint leaves out the rotation. It is compared before the division by z, without a branch.
    """
    means, _, scales, opacities, shown = scene
    fx, fy, cx, cy = intrinsics
    tan_x = max(cx, width - cx) / fx + 0.15 * width / fx  # where the Jacobian is clamped
    tan_y = max(cy, height - cy) / fy + 0.15 * height / fy
    wide = _MOST_REACH * fx * np.sqrt(1.0 + tan_x * tan_x)
    high = _MOST_REACH * fy * np.sqrt(1.0 + tan_y * tan_y)
    least = np.float32(1.0 / 255.0)
    first = block * BLOCK
    at = first
    for i in range(first, min(len(means), first + BLOCK)):
        if i < len(shown) and not shown[i]:
            continue
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
        found[at] = i
        at += not missed
    return at - first


@in_threads(lambda *arguments: len(arguments[-1]))
@kernel
def find_candidates(taken, scene, viewmat, intrinsics, width, height, found, counts):
    """Write the Gaussians that may reach the image into found (N,), those of block b from 2048 b on: counts[b] of them.

    `scene` is means, quats, scales, opacities, and which of the first S Gaussians are drawn (S,); all others are.
    """
    block = take_next(taken)
    while block < len(counts):
        counts[block] = _find_in_block(block, scene, viewmat, intrinsics, width, height, found)
        block = take_next(taken)


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
def _log2(x):
    """Return log2 of a positive float64, within 3e-16 of its size or of 1: a series that loops over vectors can use.

    References:
        log x = 2 artanh((x - 1) / (x + 1)), for x between the roots of 1/2 and 2.
    """
    number = np.float64(x)
    bits = number.view(np.int64)
    exponent = (bits - _ROOT_HALF) >> 52
    rest = np.int64(bits - (exponent << 52))
    part = rest.view(np.float64)
    s = (part - 1.0) / (part + 1.0)
    q = s * s
    series = 1.0 / 15.0 + q * (1.0 / 17.0 + q * (1.0 / 19.0))
    series = 1.0 / 9.0 + q * (1.0 / 11.0 + q * (1.0 / 13.0 + q * series))
    series = 1.0 + q * (1.0 / 3.0 + q * (1.0 / 5.0 + q * (1.0 / 7.0 + q * series)))
    return exponent + 2.0 * LOG2E * s * series


@uncounted
def _entries(viewmat):
    """Return the first three rows of a pose as numbers, which no array can change."""
    x = viewmat[0]
    y = viewmat[1]
    z = viewmat[2]
    return x[0], x[1], x[2], x[3], y[0], y[1], y[2], y[3], z[0], z[1], z[2], z[3]


@uncounted
def _gather(scene, candidates, rows):
    """Write the arrays of candidates into rows (_ROWS * 2048,), one behind the other."""
    means, quats, scales, opacities, _ = scene
    for k in range(len(candidates)):
        i = candidates[k]
        for e in range(3):
            rows[e * BLOCK + k] = means[i, e]
            rows[(3 + e) * BLOCK + k] = scales[i, e]
        for e in range(4):
            rows[(6 + e) * BLOCK + k] = quats[i, e]
        rows[10 * BLOCK + k] = opacities[i]


@uncounted(fastmath=FUSED, error_model="numpy")
def _find_splats(rows, count, viewmat, intrinsics, width, height, antialiased):
    """Project gathered Gaussians: the eight entries of a splat, depth and opacity go to the rows from 0 on.

    One array and no branch, so that the compiler makes vectors of Gaussians.
    """
    fx, fy, cx, cy = intrinsics
    a00, a01, a02, a03, a10, a11, a12, a13, a20, a21, a22, a23 = _entries(viewmat)
    least_u = -cx / fx - 0.15 * width / fx
    most_u = (width - cx) / fx + 0.15 * width / fx
    least_v = -cy / fy - 0.15 * height / fy
    most_v = (height - cy) / fy + 0.15 * height / fy
    for j in range(count):
        p = rows[j]
        q = rows[BLOCK + j]
        r = rows[2 * BLOCK + j]
        x = a00 * p + a01 * q + a02 * r + a03
        y = a10 * p + a11 * q + a12 * r + a13
        z = a20 * p + a21 * q + a22 * r + a23
        u = x / z
        v = y / z
        clamped_u = min(max(u, least_u), most_u)
        clamped_v = min(max(v, least_v), most_v)
        turned = _rotation(rows[6 * BLOCK + j], rows[7 * BLOCK + j], rows[8 * BLOCK + j], rows[9 * BLOCK + j])
        r00, r01, r02, r10, r11, r12, r20, r21, r22 = turned
        jx = fx / z
        jy = fy / z
        s = rows[3 * BLOCK + j]
        c = a20 * r00 + a21 * r10 + a22 * r20
        m00 = jx * s * (a00 * r00 + a01 * r10 + a02 * r20 - clamped_u * c)
        m10 = jy * s * (a10 * r00 + a11 * r10 + a12 * r20 - clamped_v * c)
        s = rows[4 * BLOCK + j]
        c = a20 * r01 + a21 * r11 + a22 * r21
        m01 = jx * s * (a00 * r01 + a01 * r11 + a02 * r21 - clamped_u * c)
        m11 = jy * s * (a10 * r01 + a11 * r11 + a12 * r21 - clamped_v * c)
        s = rows[5 * BLOCK + j]
        c = a20 * r02 + a21 * r12 + a22 * r22
        m02 = jx * s * (a00 * r02 + a01 * r12 + a02 * r22 - clamped_u * c)
        m12 = jy * s * (a10 * r02 + a11 * r12 + a12 * r22 - clamped_v * c)
        xx = m00 * m00 + m01 * m01 + m02 * m02
        xy = m00 * m10 + m01 * m11 + m02 * m12
        yy = m10 * m10 + m11 * m11 + m12 * m12
        p = m01 * m12 - m02 * m11
        q = m02 * m10 - m00 * m12
        r = m00 * m11 - m01 * m10
        det = p * p + q * q + r * r  # without cancellation
        full = det + DILATION * (xx + yy) + DILATION * DILATION
        opacity = rows[10 * BLOCK + j]
        if antialiased:
            opacity = opacity * np.sqrt(det / full)
        xx = xx + DILATION
        yy = yy + DILATION
        level = _log2(opacity)
        reach = np.sqrt(2.0 / LOG2E * max(level + LOG2_255, 0.0)) * (1.0 + 1e-6)
        rows[j] = fx * u + cx
        rows[BLOCK + j] = fy * v + cy
        rows[2 * BLOCK + j] = -0.5 * LOG2E * yy / full
        rows[3 * BLOCK + j] = LOG2E * xy / full
        rows[4 * BLOCK + j] = -0.5 * LOG2E * xx / full
        rows[5 * BLOCK + j] = level
        rows[6 * BLOCK + j] = reach * np.sqrt(xx)
        rows[7 * BLOCK + j] = reach * np.sqrt(yy)
        rows[8 * BLOCK + j] = z
        rows[9 * BLOCK + j] = opacity if full < np.inf else 0.0


@uncounted
def _keep_visible(candidates, rows, width, height, ids, splats, depths):
    """Write the projected candidates that reach a pixel; return their number."""
    at = 0
    for k in range(len(candidates)):
        u = rows[k]
        v = rows[BLOCK + k]
        half_x = rows[6 * BLOCK + k]
        half_y = rows[7 * BLOCK + k]
        if not rows[9 * BLOCK + k] * 255.0 >= 1.0:
            continue
        if u + half_x < 0.5 or u - half_x > width - 0.5 or v + half_y < 0.5 or v - half_y > height - 0.5:
            continue
        ids[at] = candidates[k]
        for e in range(8):
            splats[at, e] = rows[e * BLOCK + k]
        depths[at] = rows[8 * BLOCK + k]
        at += 1
    return at


@in_threads(lambda *arguments: len(arguments[-1]))
@kernel(error_model="numpy")
def project(taken, scene, viewmat, intrinsics, width, height, antialiased, found, places, ids, splats, depths, counts):
    """Project the candidates of all blocks; block b keeps its visible ones from places[b] on, counts[b] of them.

    `scene`, `found` and `counts` are those of `find_candidates`; places (blocks + 1,) are the sums of `counts`.
    """
    block = take_next(taken)
    rows = np.empty(_ROWS * BLOCK if block < len(counts) else 0)
    while block < len(counts):
        first = block * BLOCK
        candidates = found[first : first + counts[block]]
        begin = places[block]
        end = places[block + 1]
        _gather(scene, candidates, rows)
        _find_splats(rows, len(candidates), viewmat, intrinsics, width, height, antialiased)
        counts[block] = _keep_visible(
            candidates, rows, width, height, ids[begin:end], splats[begin:end], depths[begin:end]
        )
        block = take_next(taken)


@kernel
def close_gaps(places, counts, ids, splats, depths):
    """Close the gaps that `project` leaves between blocks, in place; return the number of splats.

    In place, because new memory costs more than the moves: a page of it is cleared by the system before it is written.
    """
    at = 0
    for block in range(len(counts)):
        first = places[block]
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
