"""Kernels that traverse the hierarchy: what a ray meets, how much light is left, the weight of each Gaussian.

All arrays are checked and contiguous; world frame, scene units, float64 arithmetic. `table` has one row of 16 float32
per Gaussian in hierarchy order, which fills a cache line; the constants below say what is where.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from gsvis._kernels.bits import lowest
from gsvis._kernels.compiled import inner, kernel, njit, uncounted
from gsvis._kernels.prefetch import prefetch
from gsvis._kernels.shared import share, take_next
from gsvis._kernels.threads import in_parts, on_numba_threads
from gsvis.raycast._kernels.bvh import MOST_LEVELS, WIDTH
from gsvis.raycast._kernels.simd import EIGHT, meets_eight, peaks_of_eight

# Columns of a row. A float64 is split into two float32, its rounded value and the rest.
# 0 to 2 are the mean, 3 to 6 the unit quaternion wxyz, 7 to 9 the inverse standard deviations, 13 to 15 their rests.
REACH = 10  # squared, in standard deviations
OPACITY = 11
RANK = 12  # among Gaussians of equal mean

STACK = 1 + (WIDTH - 1) * MOST_LEVELS  # a traversal leaves at most seven children waiting on each level
WAITING = 32  # Gaussians that may wait, a power of two
_LOADING = 4  # Gaussians whose rows are loaded while eight others are met
_LINE = 16  # float32 of a cache line
_PRUNE_EVERY = 16
TINY = 1e-300


class Room(NamedTuple):
    """Room for what waits while a ray traverses the hierarchy; see `make_room`.

    Attributes:
        waiting: (STACK + WAITING,) int64, nodes, then a ring of Gaussians.
        entries: (STACK,) float64, where the ray meets these nodes.
        near: (WIDTH,) float64, where it meets the children of a node.
        squares: (EIGHT,) float64 and
        peaks: (EIGHT,) float64, as `peaks_of_eight` writes them.
    """

    waiting: Any
    entries: Any
    near: Any
    squares: Any
    peaks: Any


@inner
def make_room():
    """Return a new room, for one ray at a time."""
    return Room(
        np.empty(STACK + WAITING, np.int64),
        np.empty(STACK, np.float64),
        np.empty(WIDTH, np.float64),
        np.empty(EIGHT, np.float64),
        np.empty(EIGHT, np.float64),
    )


@njit(cache=True, inline="always")
def peak_of(table, g, ox, oy, oz, dx, dy, dz):
    """Return the least squared distance on the ray, in standard deviations, and the t of the line's largest response.

    A negative t lies behind the origin; the half-line's largest response is then at the origin, at depth 0.
    """
    row = table[g]
    x = ox - row[0]
    y = oy - row[1]
    z = oz - row[2]
    w = np.float64(row[3])
    i = np.float64(row[4])
    j = np.float64(row[5])
    k = np.float64(row[6])
    inverse_x = np.float64(row[7]) + np.float64(row[13])
    inverse_y = np.float64(row[8]) + np.float64(row[14])
    inverse_z = np.float64(row[9]) + np.float64(row[15])
    # Columns of the rotation, which are the principal axes.
    xx = 1.0 - 2.0 * (j * j + k * k)
    xy = 2.0 * (i * j + w * k)
    xz = 2.0 * (i * k - w * j)
    yx = 2.0 * (i * j - w * k)
    yy = 1.0 - 2.0 * (i * i + k * k)
    yz = 2.0 * (j * k + w * i)
    zx = 2.0 * (i * k + w * j)
    zy = 2.0 * (j * k - w * i)
    zz = 1.0 - 2.0 * (i * i + j * j)
    px = (xx * x + xy * y + xz * z) * inverse_x
    py = (yx * x + yy * y + yz * z) * inverse_y
    pz = (zx * x + zy * y + zz * z) * inverse_z
    qx = (xx * dx + xy * dy + xz * dz) * inverse_x
    qy = (yx * dx + yy * dy + yz * dz) * inverse_y
    qz = (zx * dx + zy * dy + zz * dz) * inverse_z
    along = px * qx + py * qy + pz * qz
    length = qx * qx + qy * qy + qz * qz
    if along >= 0.0:
        return px * px + py * py + pz * pz, -along / length
    cx = py * qz - pz * qy
    cy = pz * qx - px * qz
    cz = px * qy - py * qx
    return (cx * cx + cy * cy + cz * cz) / length, -along / length


@uncounted
def before(table, i, depth_i, j, depth_j):
    """Return whether hit i comes before hit j: by float32 depth, and at equal depth by content, never by index."""
    if depth_i != depth_j:
        return depth_i < depth_j
    for c in range(3):
        if table[i, c] != table[j, c]:
            return table[i, c] < table[j, c]
    return table[i, RANK] < table[j, RANK]


@uncounted
def sort_hits(table, ids, alphas, depths, count):
    """Order the first `count` hits front to back, in place (shell sort: short, nearly sorted lists)."""
    for gap in (132, 57, 23, 10, 4, 1):
        for i in range(gap, count):
            g = ids[i]
            a = alphas[i]
            t = depths[i]
            j = i
            while j >= gap and before(table, g, t, ids[j - gap], depths[j - gap]):
                ids[j], alphas[j], depths[j] = ids[j - gap], alphas[j - gap], depths[j - gap]
                j -= gap
            ids[j] = g
            alphas[j] = a
            depths[j] = t


@uncounted
def count_until_spent(alphas, count, min_transmittance):
    """Return how many of the sorted hits count: up to the one where transmittance falls below the bound."""
    transmittance = 1.0
    for i in range(count):
        transmittance *= 1.0 - alphas[i]
        if transmittance < min_transmittance:
            return i + 1
    return count


@inner
def trace_ray(table, boxes, children, ray_o, ray_d, limits, ids, alphas, depths, room):
    """Find all hits of one ray, sorted and cut where transmittance is spent.

    `limits` is (min_alpha, max_alpha, min_transmittance). Returns the number of hits and the buffers. Full buffers are
    replaced by larger ones.
    """
    scene = table, boxes, children
    count = _find_hits(scene, ray_o, ray_d, limits, ids, alphas, depths, room)
    while count < 0:
        ids = np.empty(2 * len(ids), np.int64)
        alphas = np.empty(len(ids), np.float64)
        depths = np.empty(len(ids), np.float32)
        count = _find_hits(scene, ray_o, ray_d, limits, ids, alphas, depths, room)
    return count, ids, alphas, depths


@uncounted
def _visit(scene, node, ray, t_stop, room, top, last):
    """Push what a ray meets of a node, nodes on the stack and Gaussians on the queue behind it, and start to load it.

    Args:
        scene: Table, boxes and children.
        node: The node.
        ray: Its origin and its inverse direction.
        t_stop: Where its light is spent.
        room: Changed in place.
        top: Number of nodes that wait.
        last: Number of the next Gaussian of the queue.

    Returns:
        The new `top` and `last`.
    """
    table, boxes, children = scene
    met = np.uint64(meets_eight(boxes, node, ray[0], ray[1], t_stop, room.near))
    base = top
    while met != 0:
        k = lowest(met)
        met &= met - np.uint64(1)
        near = room.near[k]
        child = children[node, k]
        if child < 0:
            prefetch(table, table.shape[1] * (-1 - child))
            room.waiting[STACK + (last & WAITING - 1)] = -1 - child
            last += 1
            continue
        for line in range(0, 6 * WIDTH, _LINE):
            prefetch(boxes, 6 * WIDTH * child + line)
        prefetch(children, WIDTH * child)
        j = top
        while j > base and room.entries[j - 1] < near:  # keep the part of this node sorted, nearest on top
            room.entries[j], room.waiting[j] = room.entries[j - 1], room.waiting[j - 1]
            j -= 1
        room.entries[j] = near
        room.waiting[j] = child
        top += 1
    return top, last


@uncounted
def _meet_eight(table, ray_o, ray_d, room, first, last):
    """Write where a ray comes nearest to the next eight of the queue, or to those left; return a mask of those met."""
    start = STACK + (first & WAITING - 1)
    some = min(last - first, EIGHT)
    for k in range(some, EIGHT):
        room.waiting[start + k] = room.waiting[start]
    origin = (ray_o[0], ray_o[1], ray_o[2])
    direction = (ray_d[0], ray_d[1], ray_d[2])
    met = peaks_of_eight(table, room.waiting, start, origin, direction, room.squares, room.peaks)
    return np.uint64(met) & ((np.uint64(1) << np.uint64(some)) - np.uint64(1))


@uncounted
def _find_hits(scene, ray_o, ray_d, limits, ids, alphas, depths, room):
    """Write the hits of one ray into the buffers; see `trace_ray`. Returns their number, or -1 if a buffer is full.

    Gaussians wait until eight are there and some more after them, because rows of the table are far in memory.
    """
    table = scene[0]
    min_alpha, max_alpha, min_transmittance = limits
    dx = ray_d[0]
    dy = ray_d[1]
    dz = ray_d[2]
    inverse = (1.0 / (dx if dx != 0.0 else TINY), 1.0 / (dy if dy != 0.0 else TINY), 1.0 / (dz if dz != 0.0 else TINY))
    ray = (ray_o[0], ray_o[1], ray_o[2]), inverse
    t_stop = np.inf
    left = 1.0  # transmittance behind all hits found so far
    count = np.int64(0)
    prune_at = 0
    room.waiting[0] = 0
    room.entries[0] = 0.0
    top = 1
    first = 0
    last = 0
    while top > 0 or first < last:
        if top > 0:
            top -= 1
            if room.entries[top] <= t_stop:
                top, last = _visit(scene, room.waiting[top], ray, t_stop, room, top, last)
        while last - first > (EIGHT + _LOADING if top > 0 else 0):
            met = _meet_eight(table, ray_o, ray_d, room, first, last)
            start = STACK + (first & WAITING - 1)
            first = min(first + EIGHT, last)
            while met != 0:
                k = lowest(met)
                met &= met - np.uint64(1)
                g = room.waiting[start + np.int64(k)]
                depth = room.peaks[k]
                if depth > t_stop:
                    continue
                alpha = table[g, OPACITY] * np.exp(-0.5 * room.squares[k])
                if alpha < min_alpha:
                    continue
                if count == len(ids):
                    return np.int64(-1)
                alpha = min(alpha, max_alpha)
                ids[count], alphas[count], depths[count] = g, alpha, np.float32(depth)
                count += 1
                left *= 1.0 - alpha
                if left < min_transmittance and count >= prune_at:
                    sort_hits(table, ids, alphas, depths, count)
                    count = count_until_spent(alphas, count, min_transmittance)
                    t_stop = max(np.float64(depths[count - 1]) * (1.0 + 1e-6), 0.0)
                    prune_at = count + _PRUNE_EVERY
    sort_hits(table, ids, alphas, depths, count)
    return np.int64(count_until_spent(alphas, count, min_transmittance))


@uncounted
def weight_of(table, boxes, children, ray_o, ray_d, target, limits, floor, room):
    """Return the weight of one Gaussian on one ray, or 0 below `floor`, so that hidden Gaussians end early.

    Transmittance is a product, so occluders need no order and no list.
    """
    min_alpha, max_alpha, min_transmittance = limits
    ox = ray_o[0]
    oy = ray_o[1]
    oz = ray_o[2]
    dx = ray_d[0]
    dy = ray_d[1]
    dz = ray_d[2]
    squared, depth = peak_of(table, target, ox, oy, oz, dx, dy, dz)
    alpha = table[target, OPACITY] * np.exp(-0.5 * squared)
    if alpha < min_alpha:
        return 0.0
    alpha = min(alpha, max_alpha)
    end = np.float32(depth)
    t_stop = max(np.float64(end) * (1.0 + 1e-6), 0.0)
    least = max(floor / alpha, min_transmittance)
    origin = (ox, oy, oz)
    inverse = (1.0 / (dx if dx != 0.0 else TINY), 1.0 / (dy if dy != 0.0 else TINY), 1.0 / (dz if dz != 0.0 else TINY))
    left = 1.0
    room.waiting[0] = 0
    room.entries[0] = 0.0
    top = 1
    while top > 0:
        top -= 1
        node = room.waiting[top]
        met = meets_eight(boxes, node, origin, inverse, t_stop, room.near)
        base = top
        for k in range(WIDTH):
            if not (met >> k) & 1:
                continue
            child = children[node, k]
            if child >= 0:
                j = top
                while j > base and room.entries[j - 1] < room.near[k]:
                    room.entries[j], room.waiting[j] = room.entries[j - 1], room.waiting[j - 1]
                    j -= 1
                room.entries[j] = room.near[k]
                room.waiting[j] = child
                top += 1
                continue
            g = -1 - child
            if g == target:
                continue
            squared, depth = peak_of(table, g, ox, oy, oz, dx, dy, dz)
            if squared > table[g, REACH] or depth > t_stop:
                continue
            other = table[g, OPACITY] * np.exp(-0.5 * squared)
            if other >= min_alpha and before(table, g, np.float32(depth), target, end):
                left *= 1.0 - min(other, max_alpha)
                if left < least:
                    return 0.0
    return alpha * left


@in_parts(lambda table, boxes, children, rays_o, *_: (len(rays_o) + 255) // 256)
@kernel(error_model="numpy")
def weights_of(begin, end, table, boxes, children, rays_o, rays_d, targets, limits, floor, out):
    """Write the weight of targets[r] on ray r into out (R,)."""
    for block in range(begin, end):
        room = make_room()
        for r in range(256 * block, min(len(rays_o), 256 * block + 256)):
            out[r] = weight_of(
                table,
                boxes,
                children,
                rays_o[r],
                rays_d[r],
                targets[r],
                limits,
                floor,
                room,
            )


@in_parts(lambda table, boxes, children, rays_o, *_: (len(rays_o) + 63) // 64)
@kernel(error_model="numpy")
def trace_rays(
    begin,
    end,
    table,
    boxes,
    children,
    rays_o,
    rays_d,
    limits,
    out_count,
    out_ids,
    out_alphas,
    out_weights,
    out_depths,
):
    """Trace many rays into (R, capacity) arrays; `out_count` holds the true number, which may exceed the capacity."""
    capacity = out_ids.shape[1]
    for block in range(begin, end):
        ids = np.empty(512, np.int64)
        alphas = np.empty(512, np.float64)
        depths = np.empty(512, np.float32)
        room = make_room()
        for r in range(64 * block, min(len(rays_o), 64 * block + 64)):
            count, ids, alphas, depths = trace_ray(
                table,
                boxes,
                children,
                rays_o[r],
                rays_d[r],
                limits,
                ids,
                alphas,
                depths,
                room,
            )
            out_count[r] = count
            if count <= capacity:
                store(ids, alphas, depths, count, out_ids[r], out_alphas[r], out_weights[r], out_depths[r])


@uncounted
def store(ids, alphas, depths, count, out_ids, out_alphas, out_weights, out_depths):
    """Write the sorted hits of one ray with their weights into its output row."""
    transmittance = 1.0
    for i in range(count):
        out_ids[i], out_alphas[i], out_depths[i] = ids[i], alphas[i], max(depths[i], np.float32(0.0))
        out_weights[i] = alphas[i] * transmittance
        transmittance *= 1.0 - alphas[i]


@in_parts(lambda table, rays_o, *_: len(rays_o))
@kernel(error_model="numpy")
def weigh_candidates(
    begin,
    end,
    table,
    rays_o,
    rays_d,
    limits,
    offsets,
    candidates,
    out_count,
    out_alphas,
    out_weights,
    out_depths,
):
    """Evaluate, sort and cut the candidates of each ray in place: ray r owns offsets[r]:offsets[r + 1].

    `candidates` are distinct positions within a ray; on return its first out_count[r] entries are the hits.
    """
    min_alpha, max_alpha, min_transmittance = limits
    for r in range(begin, end):
        start = offsets[r]
        stop = offsets[r + 1]
        ids = np.empty(stop - start, np.int64)
        alphas = np.empty(stop - start, np.float64)
        depths = np.empty(stop - start, np.float32)
        count = np.int64(0)
        for c in range(start, stop):
            g = candidates[c]
            squared, depth = peak_of(
                table, g, rays_o[r, 0], rays_o[r, 1], rays_o[r, 2], rays_d[r, 0], rays_d[r, 1], rays_d[r, 2]
            )
            alpha = table[g, OPACITY] * np.exp(-0.5 * squared)
            if squared <= table[g, REACH] and alpha >= min_alpha:
                ids[count], alphas[count], depths[count] = g, min(alpha, max_alpha), np.float32(depth)
                count += 1
        sort_hits(table, ids, alphas, depths, count)
        count = count_until_spent(alphas, count, min_transmittance)
        out_count[r] = count
        store(
            ids,
            alphas,
            depths,
            count,
            candidates[start:stop],
            out_alphas[start:stop],
            out_weights[start:stop],
            out_depths[start:stop],
        )


@inner(error_model="numpy")
def _raise_row(row, table, boxes, children, rays_o, rays_d, limits, taken, out):
    """Raise the entries of a row of `out` to the weights of some rays; see `largest_weights`."""
    ids = np.empty(512, np.int64)
    alphas = np.empty(512, np.float64)
    depths = np.empty(512, np.float32)
    room = make_room()
    first = 64 * take_next(taken)
    while first < len(rays_o):
        for r in range(first, min(len(rays_o), first + 64)):
            count, ids, alphas, depths = trace_ray(
                table,
                boxes,
                children,
                rays_o[r],
                rays_d[r],
                limits,
                ids,
                alphas,
                depths,
                room,
            )
            transmittance = 1.0
            for i in range(count):
                out[row, ids[i]] = max(out[row, ids[i]], np.float32(alphas[i] * transmittance))
                transmittance *= 1.0 - alphas[i]
        first = 64 * take_next(taken)


@on_numba_threads
@kernel
def largest_weights(table, boxes, children, rays_o, rays_d, limits, out):
    """Write the largest weight of every Gaussian over the rays into out (threads, N) float32; rows are to be joined."""
    share(
        _raise_row,
        len(out),
        (table, boxes, children, rays_o, rays_d, limits, np.zeros(1, np.int64), out),
    )


@in_parts(lambda owners, offsets, rays, *_: len(rays))
@kernel(error_model="numpy")
def pack(
    begin,
    end,
    owners,
    offsets,
    rays,
    ids,
    alphas,
    weights,
    depths,
    out_ids,
    out_alphas,
    out_weights,
    out_depths,
):
    """Copy padded rows into CSR arrays, with positions converted to Gaussians by `owners`.

    Row i holds ray rays[i]; rows too short for their ray are skipped.
    """
    capacity = ids.shape[1]
    for i in range(begin, end):
        start = offsets[rays[i]]
        stop = offsets[rays[i] + 1]
        if stop - start <= capacity:
            for k in range(stop - start):
                out_ids[start + k] = owners[ids[i, k]]
                out_alphas[start + k] = alphas[i, k]
                out_weights[start + k] = weights[i, k]
                out_depths[start + k] = depths[i, k]
