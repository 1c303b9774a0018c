"""`look_around` as it was at commit fc12d0b: one face a part of a `prange`, one list a face. The ruler of `look.py`."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, prange, types
from numba.extending import intrinsic
from numpy.typing import NDArray

from gsvis._kernels.simd import Builder
from gsvis.hpr import Splats

__all__ = ["look_before"]

LANES = 16
_LOG2_255 = 7.994353436858858
_I64 = ir.IntType(64)


@intrinsic
def pass_row(typing_context, light, offset, c, slope, a, spent, most):
    """Blend a Gaussian into 16 pixels.

    Args:
        typing_context: The typing context of numba, unused.
        light: float32 array, C-contiguous; the transmittance of the pixels, changed in place.
        offset: Index of the first pixel in it.
        c: log2 alpha at the first pixel.
        slope: Linear term of log2 alpha.
        a: Quadratic term.
        spent: Transmittance below which a pixel is spent.
        most: (32,) float32, changed in place: largest weight and largest light, lane by lane.

    Returns:
        int64, bit k set if pixel k became spent.
    """
    del typing_context
    f32 = types.float32
    signature = types.int64(light, types.int64, f32, f32, f32, f32, most)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        lanes = Builder(builder, LANES, "float32")
        pixels = context.make_array(sig.args[0])(context, builder, args[0]).data
        found = context.make_array(sig.args[6])(context, builder, args[6]).data
        k = lanes.counting()
        p = lanes.splat(args[4]).times_plus(k, lanes.splat(args[3])).times_plus(k, lanes.splat(args[2]))
        before = lanes.load(pixels, args[1])
        seen = p.compare(">=", -_LOG2_255)
        weight = seen.where(p.exp2().least(0.999), 0.0) * before
        after = before - weight
        lanes.store(after, pixels, args[1])
        lit = seen.where(before, 0.0)
        for vector, first in ((weight, 0), (lit, LANES)):
            place = ir.Constant(_I64, first)
            lanes.store(lanes.load(found, place).most(vector), found, place)
        limit = lanes.splat(args[5])
        return (after.compare("<", limit) & before.compare(">=", limit)).bits()

    return signature, generate


@intrinsic
def largest_of(typing_context, most, which):
    """Return the largest of lanes 16 * which .. 16 * which + 15, and set them to 0."""
    del typing_context
    signature = types.float32(most, types.int64)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        lanes = Builder(builder, LANES, "float32")
        found = context.make_array(sig.args[0])(context, builder, args[0]).data
        place = builder.mul(args[1], ir.Constant(_I64, LANES))
        largest = lanes.load(found, place).largest()
        lanes.store(lanes.constant(0.0), found, place)
        return largest

    return signature, generate


BLOCK = 4
NEAR = 0.01
DILATION = 0.3
CLAMP = 1.3  # of x/z and y/z in the Jacobian, as in the rasterizer for a field of view of 90 degrees
_LOG2_E = 1.4426950408889634
_RECOUNT = 4  # number of Gaussians after which the bound of a block is recomputed
_CHUNK = 4096
_ONE = np.float32(1.0)


@njit(cache=True, parallel=True, nogil=True)
def sort_out(near, eye, focal, masks, keys):
    """Write for each Gaussian the faces it may reach, one bit each, and its squared distance from the eye.

    `near` (M, 8) float32 holds mean, largest scale, reach in standard deviations, opacity, and two unused numbers.
    """
    count = len(near)
    ex, ey, ez = eye[0], eye[1], eye[2]
    blur = np.float32(math.sqrt(DILATION)) / focal
    for chunk in prange((count + _CHUNK - 1) // _CHUNK):
        for i in range(_CHUNK * chunk, min(count, _CHUNK * chunk + _CHUNK)):
            dx, dy, dz = near[i, 0] - ex, near[i, 1] - ey, near[i, 2] - ez
            keys[i] = dx * dx + dy * dy + dz * dz
            mask = _reaches(dx, dy, dz, near[i, 3], near[i, 4], blur)
            mask |= _reaches(dy, dz, dx, near[i, 3], near[i, 4], blur) << 2
            masks[i] = mask | _reaches(dz, dx, dy, near[i, 3], near[i, 4], blur) << 4


@njit(cache=True)
def _reaches(w, u, v, scale, reach, blur):
    """Return 1 or 2 if the splat may reach the face that looks along w or along -w, else 0."""
    z = abs(w)
    if z <= NEAR:
        return np.uint8(0)
    tu, tv = abs(u) / z, abs(v) / z
    cu, cv = min(tu, CLAMP), min(tv, CLAMP)
    # (scale / z) sqrt(1 + cu^2 + cv^2) bounds the largest singular value of the Jacobian times the Gaussian's
    radius = reach * (scale / z * math.sqrt(1.0 + cu * cu + cv * cv) + blur)
    if max(tu, tv) - radius > 1.0:
        return np.uint8(0)
    return np.uint8(1) if w > 0.0 else np.uint8(2)


@njit(cache=True)
def _members(masks, keys, bit):
    """Return the Gaussians with that bit, nearest first; ties keep the order of the table."""
    count = 0
    for i in range(len(masks)):
        count += (masks[i] & bit) != 0
    ids, ids_b = np.empty(count, np.int32), np.empty(count, np.int32)
    some, some_b = np.empty(count, np.uint32), np.empty(count, np.uint32)
    count = 0
    for i in range(len(masks)):
        if masks[i] & bit:
            ids[count], some[count] = i, keys[i]
            count += 1
    counts = np.zeros((3, 2048), np.int64)  # a radix sort: three passes of 11 bits
    for i in range(count):
        key = some[i]
        counts[0, key & 2047] += 1
        counts[1, (key >> 11) & 2047] += 1
        counts[2, key >> 22] += 1
    for step in range(3):
        total = 0
        for b in range(2048):
            here = counts[step, b]
            counts[step, b] = total
            total += here
    for step in range(3):
        for i in range(count):
            b = (some[i] >> (11 * step)) & 2047
            at = counts[step, b]
            counts[step, b] = at + 1
            some_b[at], ids_b[at] = some[i], ids[i]
        some, some_b, ids, ids_b = some_b, some, ids_b, ids
    return ids


@njit(cache=True, parallel=True, nogil=True)
def splat_faces(near, covars, eye, size, masks, keys, faces, spent, light, depths, out_ids, out_values, counts):
    """Splat what each face may see, front to back.

    `covars` is (M, 6) float32; `keys` are the squared distances as uint32 bits; `faces` are the six in processing
    order. `light` (6, S, S + LANES) starts as 1, its margin as 0, and ends as the transmittance behind everything.
    `depths` (6, S, S) starts as inf and ends as the distance at which the light fell below `spent`. Some light reaches
    counts[k] Gaussians on face k: out_ids[k], and in out_values[k] the largest weight and the largest light in front.
    """
    for n in prange(6):
        face = faces[n]
        ids = _members(masks, keys, np.uint8(1 << face))
        counts[face] = _splat(
            near, covars, eye, size, face, ids, np.float32(spent), light[face], depths[face],
            out_ids[face], out_values[face],
        )  # fmt: skip


@njit(cache=True)
def _any_lit(bounds, x0, x1, y0, y1, spent):
    """Return whether a block under the pixels x0..x1, y0..y1 may hold light."""
    for by in range(y0 // BLOCK, y1 // BLOCK + 1):
        for bx in range(x0 // BLOCK, x1 // BLOCK + 1):
            if bounds[by, bx] >= spent:
                return True
    return False


@njit(cache=True)
def _bound(light, size, bx, by):
    most = np.float32(0.0)
    for y in range(by * BLOCK, min(by * BLOCK + BLOCK, size)):
        for x in range(bx * BLOCK, min(bx * BLOCK + BLOCK, size)):
            most = max(most, light[y, x])
    return most


@njit(cache=True)
def _pixels(center, radius, size):
    """Return the first and the last pixel with its center within the radius."""
    return (
        max(math.ceil(center - radius - np.float32(0.5)), 0),
        min(math.floor(center + radius - np.float32(0.5)), size - 1),
    )


@njit(cache=True)
def _splat(near, covars, eye, size, face, ids, spent, light, depths, out_ids, out_values):
    axis = face >> 1
    au, av = (1 if axis == 0 else 0), (1 if axis == 2 else 2)
    sign = np.float32(1.0 - 2.0 * (face & 1))
    half, clamp = np.float32(0.5 * size), np.float32(CLAMP)
    blocks = (size + BLOCK - 1) // BLOCK
    bounds, touched = np.ones((blocks, blocks), np.float32), np.zeros((blocks, blocks), np.int32)
    lit_blocks, stride, found = blocks * blocks, light.shape[1], 0
    most = np.zeros(2 * LANES, np.float32)
    ju, jv = np.zeros(3, np.float32), np.zeros(3, np.float32)  # rows of the Jacobian, world axes
    for n in range(len(ids)):
        if lit_blocks == 0:
            break
        i = ids[n]
        du, dv = near[i, au] - eye[au], near[i, av] - eye[av]
        z = sign * (near[i, axis] - eye[axis])
        inverse = _ONE / z
        tu, tv = du * inverse, dv * inverse
        cu, cv = min(max(tu, -clamp), clamp), min(max(tv, -clamp), clamp)
        scale = half * inverse
        wide = near[i, 3] * scale
        radius = near[i, 4] * math.sqrt(wide * wide * (_ONE + cu * cu + cv * cv) + np.float32(DILATION))
        px, py = half * tu + half, half * tv + half
        x0, x1 = _pixels(px, radius, size)
        y0, y1 = _pixels(py, radius, size)
        if x0 > x1 or y0 > y1 or not _any_lit(bounds, x0, x1, y0, y1, spent):
            continue
        row = covars[i]
        ju[au], ju[av], ju[axis] = scale, 0.0, -scale * cu * sign
        jv[au], jv[av], jv[axis] = 0.0, scale, -scale * cv * sign
        ax = row[0] * ju[0] + row[1] * ju[1] + row[2] * ju[2]
        ay = row[1] * ju[0] + row[3] * ju[1] + row[4] * ju[2]
        az = row[2] * ju[0] + row[4] * ju[1] + row[5] * ju[2]
        bx = row[0] * jv[0] + row[1] * jv[1] + row[2] * jv[2]
        by = row[1] * jv[0] + row[3] * jv[1] + row[4] * jv[2]
        bz = row[2] * jv[0] + row[4] * jv[1] + row[5] * jv[2]
        sxx = np.float64(ax * ju[0] + ay * ju[1] + az * ju[2]) + DILATION
        sxy = np.float64(ax * jv[0] + ay * jv[1] + az * jv[2])
        syy = np.float64(bx * jv[0] + by * jv[1] + bz * jv[2]) + DILATION
        level = np.float64(near[i, 4]) * near[i, 4]
        # A thin splat far off the axis: rounding must not make its determinant 0.
        det = max(sxx * syy - sxy * sxy, DILATION * DILATION)
        a, b, c = syy / det, -sxy / det, sxx / det
        x0, x1 = _pixels(px, math.sqrt(level * sxx), size)
        y0, y1 = _pixels(py, math.sqrt(level * syy), size)
        if x0 > x1 or y0 > y1 or not _any_lit(bounds, x0, x1, y0, y1, spent):
            continue
        qa, qb, qc = -0.5 * _LOG2_E * a, -_LOG2_E * b, -0.5 * _LOG2_E * c
        top = math.log2(np.float64(near[i, 5]))
        narrow, first, last = x1 - x0 < LANES, x0, x1
        for y in range(y0, y1 + 1):
            dy = y + 0.5 - np.float64(py)
            if not narrow:
                inside = level - dy * dy / syy
                if inside < 0.0:
                    continue
                x0, x1 = _pixels(px - b * dy / a, math.sqrt(inside / a), size)
            x = x0
            while x <= x1:
                dx = x + 0.5 - np.float64(px)
                crossed = pass_row(
                    light,
                    y * stride + x,
                    np.float32((qa * dx + qb * dy) * dx + qc * dy * dy + top),
                    np.float32(2.0 * qa * dx + qb * dy),
                    np.float32(qa),
                    spent,
                    most,
                )
                if crossed != 0:
                    far = math.sqrt(du * du + dv * dv + z * z)
                    for k in range(LANES):
                        if (crossed >> k) & 1:
                            depths[y, x + k] = far
                x += LANES
        weight, clear = largest_of(most, 0), largest_of(most, 1)
        if clear < spent:
            continue
        out_ids[found], out_values[found, 0], out_values[found, 1] = i, weight, clear
        found += 1
        for block_y in range(y0 // BLOCK, y1 // BLOCK + 1):
            for block_x in range(first // BLOCK, last // BLOCK + 1):
                touched[block_y, block_x] += 1
                if touched[block_y, block_x] >= _RECOUNT and bounds[block_y, block_x] >= spent:
                    touched[block_y, block_x] = 0
                    bounds[block_y, block_x] = _bound(light, size, block_x, block_y)
                    lit_blocks -= bounds[block_y, block_x] < spent
    return found


@njit(cache=True, nogil=True)
def join_faces(ids, values, counts, joined, found):
    """Write the largest values over the faces into joined (M, 2) and their Gaussians into found; return how many."""
    total = 0
    for face in range(len(counts)):
        for n in range(counts[face]):
            i = ids[face, n]
            if joined[i, 1] == 0.0:
                found[total] = i
                total += 1
            joined[i, 0] = max(joined[i, 0], values[face, n, 0])
            joined[i, 1] = max(joined[i, 1], values[face, n, 1])
    return total


def look_before(
    splats: Splats, eye: NDArray[np.float64], size: int, spent: float
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Return the Gaussians that light reaches, and their largest weights."""
    rows = len(splats.near)
    masks, distances = np.empty(rows, np.uint8), np.empty(rows, np.float32)
    at = eye.astype(np.float32)
    sort_out(splats.near, at, np.float32(size / 2), masks, distances)
    light = np.ones((6, size, size + LANES), np.float32)
    light[:, :, size:] = 0.0
    depths = np.full((6, size, size), np.inf, np.float32)
    ids, values, counts = np.empty((6, rows), np.int32), np.empty((6, rows, 2), np.float32), np.zeros(6, np.int64)
    crowd = np.argsort([-np.count_nonzero(masks & np.uint8(1 << face)) for face in range(6)], kind="stable")
    work = crowd[[0, 3, 4, 1, 2, 5]], spent, light, depths, ids, values, counts
    splat_faces(splats.near, splats.covars, at, size, masks, distances.view(np.uint32), *work)
    joined, found = np.zeros((rows, 2), np.float32), np.empty(rows, np.int64)
    found = found[: join_faces(ids, values, counts, joined, found)]
    seen = splats.ids[found]
    order = np.argsort(seen)
    return seen[order], joined[found[order]][:, 0].copy()
