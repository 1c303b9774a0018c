"""Kernels of the hierarchical z-buffer: Gaussians splatted front to back onto the six faces of a cube around an eye.

A face is S x S pixels that look along one axis of the world, f = S / 2. Light that is left at each pixel (its
transmittance) stands in a buffer; over blocks of 8 x 8 pixels stands an upper bound of it, so that what comes behind
spent blocks costs one look. World frame, scene units; faces in the order +x, -x, +y, -y, +z, -z.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from gsvis.hpr._kernels_row import LANES, largest_of, pass_row

BLOCK = 8
NEAR = 0.01
DILATION = 0.3
CLAMP = 1.3  # of x/z and y/z in the Jacobian: the rasterizer's, for a field of view of 90 degrees
MAX_ALPHA = 0.999
LOG2_E = 1.4426950408889634
_RECOUNT = 24  # touches after which the bound of a block is taken anew


@njit(cache=True, parallel=True, nogil=True)
def sort_out(near, eye, focal, masks, keys):
    """For each Gaussian the faces it may reach, one bit each, and its squared distance.

    `near` (N, 5) float32 holds mean, largest scale, and reach in standard deviations.
    """
    n = len(near)
    blocks = (n + 4095) // 4096
    ex, ey, ez = eye[0], eye[1], eye[2]
    blur = np.float32(math.sqrt(DILATION)) / focal
    for block in prange(blocks):
        for i in range(4096 * block, min(n, 4096 * block + 4096)):
            dx, dy, dz = near[i, 0] - ex, near[i, 1] - ey, near[i, 2] - ez
            keys[i] = dx * dx + dy * dy + dz * dz
            mask = np.uint8(0)
            mask |= _reaches(dx, dy, dz, near[i, 3], near[i, 4], blur) << 0
            mask |= _reaches(dy, dz, dx, near[i, 3], near[i, 4], blur) << 2
            mask |= _reaches(dz, dx, dy, near[i, 3], near[i, 4], blur) << 4
            masks[i] = mask


@njit(cache=True)
def _reaches(w, u, v, scale, reach, blur):
    """1 or 2 if the splat may reach the face that looks along w or -w, else 0."""
    z = abs(w)
    if z <= NEAR:
        return np.uint8(0)
    tu, tv = abs(u) / z, abs(v) / z
    cu, cv = min(tu, CLAMP), min(tv, CLAMP)
    radius = reach * (scale / z * math.sqrt(1.0 + cu * cu + cv * cv) + blur)
    if max(tu, tv) - radius > 1.0:
        return np.uint8(0)
    return np.uint8(1) if w > 0.0 else np.uint8(2)


@njit(cache=True)
def _radix_sort(keys, ids, keys_b, ids_b):
    """Sort ids by keys (uint32, stable), three passes of 11 bits; returns the sorted ids."""
    counts = np.zeros((3, 2048), np.int64)
    for i in range(len(keys)):
        k = keys[i]
        counts[0, k & 2047] += 1
        counts[1, (k >> 11) & 2047] += 1
        counts[2, k >> 22] += 1
    for p in range(3):
        total = 0
        for b in range(2048):
            c = counts[p, b]
            counts[p, b] = total
            total += c
    shift = 0
    for p in range(3):
        for i in range(len(keys)):
            k = keys[i]
            b = (k >> shift) & 2047
            at = counts[p, b]
            counts[p, b] = at + 1
            keys_b[at] = k
            ids_b[at] = ids[i]
        keys, keys_b = keys_b, keys
        ids, ids_b = ids_b, ids
        shift += 11
    return ids


@njit(cache=True, parallel=True, nogil=True)
def splat_faces(near, table, eye, size, masks, keys, antialiased, spent, left, depths, out_ids, out_weights, counts):
    """Splat the Gaussians of each face front to back.

    `keys` are the squared distances seen as uint32. `left` (6, S, S) starts as 1 and ends as the transmittance,
    `depths` (6, S, S) starts as inf and ends as the distance at which it fell below `spent`. Face k found
    counts[k] Gaussians before spent pixels: out_ids[k] and their largest weights.
    """
    for face in prange(6):
        bit = np.uint8(1 << face)
        m = 0
        for i in range(len(masks)):
            m += (masks[i] & bit) != 0
        ids, ids_b = np.empty(m, np.int32), np.empty(m, np.int32)
        some, some_b = np.empty(m, np.uint32), np.empty(m, np.uint32)
        m = 0
        for i in range(len(masks)):
            if masks[i] & bit:
                ids[m], some[m] = i, keys[i]
                m += 1
        ids = _radix_sort(some, ids, some_b, ids_b)
        counts[face] = _splat(
            near, table, eye, size, face, ids, antialiased, spent, left[face], depths[face],
            out_ids[face], out_weights[face],
        )  # fmt: skip


@njit(cache=True)
def _block_bound(left, bx, by):
    most = np.float32(0.0)
    for y in range(by * BLOCK, min(by * BLOCK + BLOCK, left.shape[0])):
        for x in range(bx * BLOCK, min(bx * BLOCK + BLOCK, left.shape[0])):
            most = max(most, left[y, x])
    return most


@njit(cache=True)
def _splat(near, table, eye, size, face, ids, antialiased, spent, left, depths, out_ids, out_weights):
    axis = face >> 1
    au, av = (axis + 1) % 3, (axis + 2) % 3
    sign = np.float32(1.0 - 2.0 * (face & 1))
    half = np.float32(0.5 * size)
    blocks = (size + BLOCK - 1) // BLOCK
    bounds = np.ones((blocks, blocks), np.float32)
    touched = np.zeros((blocks, blocks), np.int32)
    alive = blocks * blocks
    found = 0
    ju, jv = np.zeros(3, np.float32), np.zeros(3, np.float32)
    one = np.float32(1.0)
    most = np.zeros(32, np.float32)
    stride = left.shape[1]
    spent = np.float32(spent)
    for n in range(len(ids)):
        if alive == 0:
            break
        i = ids[n]
        z = sign * (near[i, axis] - eye[axis])
        u, v = near[i, au] - eye[au], near[i, av] - eye[av]
        inverse = one / z
        tu, tv = u * inverse, v * inverse
        cu = min(max(tu, np.float32(-CLAMP)), np.float32(CLAMP))
        cv = min(max(tv, np.float32(-CLAMP)), np.float32(CLAMP))
        reach = near[i, 4]
        sigma = near[i, 3] * half * inverse
        radius = reach * math.sqrt(sigma * sigma * (one + cu * cu + cv * cv) + np.float32(DILATION))
        px, py = half * tu + half, half * tv + half
        x0, x1 = max(int(math.ceil(px - radius - 0.5)), 0), min(int(math.floor(px + radius - 0.5)), size - 1)
        y0, y1 = max(int(math.ceil(py - radius - 0.5)), 0), min(int(math.floor(py + radius - 0.5)), size - 1)
        if x0 > x1 or y0 > y1:
            continue
        lit = False
        for by in range(y0 // BLOCK, y1 // BLOCK + 1):
            for bx in range(x0 // BLOCK, x1 // BLOCK + 1):
                if bounds[by, bx] >= spent:
                    lit = True
                    break
            if lit:
                break
        if not lit:
            continue
        row = table[i]
        scale = half * inverse
        ju[au], jv[av] = scale, scale
        ju[av], jv[au] = 0.0, 0.0
        ju[axis], jv[axis] = -scale * cu * sign, -scale * cv * sign
        ax = row[0] * ju[0] + row[1] * ju[1] + row[2] * ju[2]
        ay = row[1] * ju[0] + row[3] * ju[1] + row[4] * ju[2]
        az = row[2] * ju[0] + row[4] * ju[1] + row[5] * ju[2]
        bx_ = row[0] * jv[0] + row[1] * jv[1] + row[2] * jv[2]
        by_ = row[1] * jv[0] + row[3] * jv[1] + row[4] * jv[2]
        bz_ = row[2] * jv[0] + row[4] * jv[1] + row[5] * jv[2]
        sxx = ax * ju[0] + ay * ju[1] + az * ju[2]
        sxy = ax * jv[0] + ay * jv[1] + az * jv[2]
        syy = bx_ * jv[0] + by_ * jv[1] + bz_ * jv[2]
        opacity = row[6]
        bare = max(sxx * syy - sxy * sxy, np.float32(0.0))
        sxx += np.float32(DILATION)
        syy += np.float32(DILATION)
        full = sxx * syy - sxy * sxy
        if antialiased:
            opacity *= math.sqrt(bare / full)
        level = np.float32(2.0) * math.log(np.float32(255.0) * max(opacity, np.float32(1e-30)))
        if level <= 0.0:
            level = np.float32(0.0)
        a, b, c = syy / full, -sxy / full, sxx / full
        ry, rx = math.sqrt(level * syy), math.sqrt(level * sxx)
        x0, x1 = max(int(math.ceil(px - rx - 0.5)), 0), min(int(math.floor(px + rx - 0.5)), size - 1)
        y0, y1 = max(int(math.ceil(py - ry - 0.5)), 0), min(int(math.floor(py + ry - 0.5)), size - 1)
        k0 = LOG2_E * np.float64(-0.5)
        qa, qb, qc = k0 * a, np.float64(2.0) * k0 * b, k0 * c
        top = math.log2(max(opacity, np.float32(1e-30)))
        narrow = x1 - x0 < LANES
        xa, xb = x0, x1
        for y in range(y0, y1 + 1):
            dy = y + 0.5 - np.float64(py)
            if not narrow:
                inside = level - dy * dy / syy
                if inside < 0.0:
                    continue
                reach_x = math.sqrt(inside / a)
                middle = px - b * dy / a
                x0 = max(int(math.ceil(middle - reach_x - 0.5)), 0)
                x1 = min(int(math.floor(middle + reach_x - 0.5)), size - 1)
            x = x0
            while x <= x1:
                dx = x + 0.5 - np.float64(px)
                crossed = pass_row(
                    left, y * stride + x,
                    np.float32((qa * dx + qb * dy) * dx + qc * dy * dy + top),
                    np.float32(2.0 * qa * dx + qb * dy), np.float32(qa), spent, most,
                )
                if crossed != 0:
                    far = math.sqrt((near[i, 0] - eye[0]) ** 2 + (near[i, 1] - eye[1]) ** 2 + (near[i, 2] - eye[2]) ** 2)
                    for k in range(LANES):
                        if (crossed >> k) & 1:
                            depths[y, x + k] = far
                x += LANES
        best, clear = largest_of(most, 0), largest_of(most, 1)
        if clear >= spent:
            out_ids[found], out_weights[found, 0], out_weights[found, 1] = i, best, row[6] * clear
            found += 1
            for by in range(y0 // BLOCK, y1 // BLOCK + 1):
                for bx in range(xa // BLOCK, xb // BLOCK + 1):
                    touched[by, bx] += 1
                    if touched[by, bx] >= _RECOUNT and bounds[by, bx] >= spent:
                        touched[by, bx] = 0
                        bounds[by, bx] = _block_bound(left, bx, by)
                        alive -= bounds[by, bx] < spent
    return found
