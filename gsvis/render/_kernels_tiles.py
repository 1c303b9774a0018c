"""Kernels that sort projected Gaussians into tiles and blend the tiles, forward and backward.

A tile is 16 x 16 pixels; its list holds the splats that reach alpha 1/255 at one of its pixel centres, front to back.
Lists, images and gradients do not depend on the number of threads.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from gsvis.render._kernels_lanes import CHANNELS, LANES, blend, blend_backward, weigh

TILE = LANES
_LOG2_255 = 7.994353436858858
_CHECK_EVERY = 16


@njit(cache=True)
def _less(i, j, ids, content):
    """Content order of two Gaussians of equal depth."""
    for c in range(content.shape[1]):
        if content[ids[i], c] != content[ids[j], c]:
            return content[ids[i], c] < content[ids[j], c]
    return False


@njit(cache=True)
def order_ties(order, depths, ids, content):
    """Put runs of equal depth in a depth order into content order (merge sort)."""
    scratch = np.empty(len(order), order.dtype)
    start = 0
    while start < len(order):
        stop = start + 1
        while stop < len(order) and depths[order[stop]] == depths[order[start]]:
            stop += 1
        width = 1
        while width < stop - start:
            for left in range(start, stop, 2 * width):
                middle, right = min(left + width, stop), min(left + 2 * width, stop)
                i, j = left, middle
                for k in range(left, right):
                    if i < middle and (j >= right or not _less(order[j], order[i], ids, content)):
                        scratch[k] = order[i]
                        i += 1
                    else:
                        scratch[k] = order[j]
                        j += 1
                order[left:right] = scratch[left:right]
            width *= 2
        start = stop


@njit(cache=True)
def _edge(low, high, centre, other, linear, square):
    """Where log2 alpha is largest along an edge: the free coordinate, clamped to [low, high]."""
    return min(max(centre - linear * other / (2.0 * square), low), high)


@njit(cache=True)
def _reaches(splat, left, top):
    """Whether log2 alpha reaches -log2 255 at a point of the box of the tile's pixel centres."""
    low_x, low_y = left + 0.5, top + 0.5
    high_x, high_y = low_x + TILE - 1.0, low_y + TILE - 1.0
    x, y, a, b, c, level = splat[0], splat[1], splat[2], splat[3], splat[4], splat[5]
    out_x, out_y = x < low_x or x > high_x, y < low_y or y > high_y
    if not out_x and not out_y:
        return True
    if out_x:
        dx = (low_x if x < low_x else high_x) - x
        dy = _edge(low_y, high_y, y, dx, b, c) - y
        if level + a * dx * dx + b * dx * dy + c * dy * dy >= -_LOG2_255 - 1e-6:
            return True
    if out_y:
        dy = (low_y if y < low_y else high_y) - y
        dx = _edge(low_x, high_x, x, dy, b, a) - x
        if level + a * dx * dx + b * dx * dy + c * dy * dy >= -_LOG2_255 - 1e-6:
            return True
    return False


@njit(cache=True)
def _tile_range(centre, half, tiles):
    return (
        max(int(np.floor((centre - half - 0.5) / TILE)), 0),
        min(int(np.floor((centre + half - 0.5) / TILE)), tiles - 1),
    )


@njit(cache=True, parallel=True, nogil=True)
def count_candidates(splats, tiles_x, tiles_y, out):
    """Tiles under the box of each splat into out (M,)."""
    for m in prange(len(splats)):
        x0, x1 = _tile_range(splats[m, 0], splats[m, 6], tiles_x)
        y0, y1 = _tile_range(splats[m, 1], splats[m, 7], tiles_y)
        out[m] = (x1 - x0 + 1) * (y1 - y0 + 1)


@njit(cache=True, parallel=True, nogil=True)
def meet_tiles(splats, order, first_room, tiles_x, tiles_y, met, counts, histogram):
    """Tiles that each splat reaches, splat k of the depth order from met[first_room[k]] on, counts[k] of them.

    `histogram` (chunks, tiles) receives how many splats each chunk of the order puts into each tile.
    """
    chunks = len(histogram)
    for chunk in prange(chunks):
        for k in range(len(order) * chunk // chunks, len(order) * (chunk + 1) // chunks):
            splat = splats[order[k]]
            x0, x1 = _tile_range(splat[0], splat[6], tiles_x)
            y0, y1 = _tile_range(splat[1], splat[7], tiles_y)
            at = first_room[k]
            for ty in range(y0, y1 + 1):
                for tx in range(x0, x1 + 1):
                    if _reaches(splat, tx * TILE, ty * TILE):
                        met[at] = ty * tiles_x + tx
                        histogram[chunk, ty * tiles_x + tx] += 1
                        at += 1
            counts[k] = at - first_room[k]


@njit(cache=True)
def place_chunks(histogram, offsets):
    """Turn counts (chunks, tiles) into first places, and fill offsets (tiles + 1)."""
    total = 0
    for tile in range(histogram.shape[1]):
        offsets[tile] = total
        for chunk in range(len(histogram)):
            count = histogram[chunk, tile]
            histogram[chunk, tile] = total
            total += count
    offsets[-1] = total


@njit(cache=True, parallel=True, nogil=True)
def fill_tiles(order, first_room, met, counts, first_pair, places, members, pair_of):
    """Write each tile's list, front to back; `pair_of` (may be empty) numbers the pairs along the depth order."""
    chunks = len(places)
    for chunk in prange(chunks):
        for k in range(len(order) * chunk // chunks, len(order) * (chunk + 1) // chunks):
            for i in range(counts[k]):
                tile = met[first_room[k] + i]
                place = places[chunk, tile]
                places[chunk, tile] = place + 1
                members[place] = order[k]
                if len(pair_of):
                    pair_of[place] = first_pair[k] + i


@njit(cache=True)
def _in_tile(splat, left, top):
    """Polynomial over the tile's pixels, the first and one past the last row it can touch, and the centre."""
    x, y = splat[0] - (left + 0.5), splat[1] - (top + 0.5)
    a, b, c = splat[2], splat[3], splat[4]
    polynomial = (
        np.float32(splat[5] + a * x * x + b * x * y + c * y * y),
        np.float32(-(2.0 * a * x + b * y)),
        np.float32(-(2.0 * c * y + b * x)),
        np.float32(a),
        np.float32(b),
        np.float32(c),
    )
    start = max(int(np.ceil(y - splat[7])), 0)
    stop = min(int(np.floor(y + splat[7])) + 1, TILE)
    return polynomial, start, stop, (np.float32(x), np.float32(y))


@njit(cache=True)
def _open_tile(left, top, width, height):
    """Fresh state: light everywhere inside the image, none outside, nothing blended.

    Returns the state, aligned to cache lines, and the rows and columns inside the image.
    """
    room = np.zeros(TILE * CHANNELS * TILE + 16, np.float32)
    first = (-room.ctypes.data % 64) // 4
    state = room[first : first + TILE * CHANNELS * TILE].reshape((TILE, CHANNELS, TILE))
    rows = min(TILE, height - top)
    columns = min(TILE, width - left)
    for r in range(rows):
        state[r, 7, 0] = np.inf
        for k in range(columns):
            state[r, 0, k] = 1.0
        for k in range(TILE):
            state[r, 6, k] = -1.0
    return state, rows, columns


@njit(cache=True)
def _lit_rows(state, first, last):
    """Narrow rows [first, last) to those that hold a pixel whose light is not spent."""
    low, high = last, first
    for r in range(first, last):
        if state[r, 7, 0] >= 0.0:
            low = min(low, r)
            high = r + 1
    return low, high


@njit(cache=True)
def _spread(i, count):
    """A permutation of range(count) that gives every thread tiles from all over the image."""
    stride = max(1, int(count * 0.6180339887))
    while _gcd(stride, count) != 1:
        stride += 1
    return (i * stride) % count


@njit(cache=True)
def _gcd(a, b):
    while b:
        a, b = b, a % b
    return a


@njit(cache=True, parallel=True, nogil=True)
def blend_tiles(splats, features, offsets, members, tiles_x, background, image, transmittance, depth, median, last):
    """Render all tiles. `features` is (M, 4) float32: colour and depth. Outputs are (H, W, ...)."""
    height, width = transmittance.shape
    tiles = len(offsets) - 1
    for i in prange(tiles):
        tile = _spread(i, tiles)
        left, top = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        state, rows, columns = _open_tile(left, top, width, height)
        low, high = 0, rows
        for k in range(offsets[tile], offsets[tile + 1]):
            m = members[k]
            polynomial, start, stop, _ = _in_tile(splats[m], left, top)
            feature = (features[m, 0], features[m, 1], features[m, 2], features[m, 3])
            blend(state, polynomial, feature, np.float32(k - offsets[tile]), max(start, low), min(stop, high))
            if (k - offsets[tile]) % _CHECK_EVERY == _CHECK_EVERY - 1:
                low, high = _lit_rows(state, low, high)
                if low >= high:
                    break
        for r in range(rows):
            for k in range(columns):
                left_over = abs(state[r, 0, k])
                y, x = top + r, left + k
                transmittance[y, x] = left_over
                for c in range(3):
                    image[y, x, c] = state[r, 1 + c, k] + left_over * background[c]
                covered = np.float32(1.0) - left_over
                depth[y, x] = state[r, 4, k] / covered if covered > 0.0 else np.float32(0.0)
                median[y, x] = state[r, 5, k]
                last[y, x] = state[r, 6, k]


@njit(cache=True, parallel=True, nogil=True)
def blend_tiles_backward(splats, features, offsets, members, pair_of, tiles_x, background, forward, gradients, out):
    """Gradient sums of every (tile, splat) pair into out (P, 10) float32; see `blend_backward`.

    `forward` is (transmittance, depth, last); `gradients` is by (image, alpha, depth).
    """
    transmittance, depth, last = forward
    v_image, v_alpha, v_depth = gradients
    height, width = transmittance.shape
    tiles = len(offsets) - 1
    for i in prange(tiles):
        tile = _spread(i, tiles)
        left, top = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        state, rows, columns = _open_tile(left, top, width, height)
        newest = np.float32(-1.0)
        for r in range(rows):
            state[r, 7, 0] = -1.0
            for k in range(columns):
                y, x = top + r, left + k
                t = transmittance[y, x]
                covered = np.float32(1.0) - t
                state[r, 0, k] = t
                by_t = -v_alpha[y, x]
                for c in range(3):
                    state[r, 1 + c, k] = v_image[y, x, c]
                    by_t += v_image[y, x, c] * background[c]
                if covered > 0.0:  # depth = sum(w z) / covered
                    state[r, 4, k] = v_depth[y, x] / covered
                    by_t += v_depth[y, x] * depth[y, x] / covered
                state[r, 5, k] = t * by_t
                state[r, 6, k] = last[y, x]
                state[r, 7, 0] = max(state[r, 7, 0], last[y, x])
            newest = max(newest, state[r, 7, 0])
        for k in range(offsets[tile], offsets[tile + 1]):
            place = k - offsets[tile]
            if place > newest:
                for e in range(10):
                    out[pair_of[k], e] = 0.0
        for place in range(int(newest), -1, -1):
            k = offsets[tile] + place
            m = members[k]
            polynomial, start, stop, centre = _in_tile(splats[m], left, top)
            feature = (features[m, 0], features[m, 1], features[m, 2], features[m, 3])
            sums = blend_backward(state, polynomial, feature, centre, np.float32(place), start, min(stop, rows))
            for e in range(10):
                out[pair_of[k], e] = sums[e]


@njit(cache=True, parallel=True, nogil=True)
def sum_pairs(order, first_pair, pairs, out):
    """Sum the pairs of each splat, in the order of its tiles: out (M, 10) float64."""
    for k in prange(len(order)):
        m = order[k]
        for e in range(10):
            out[m, e] = 0.0
        for p in range(first_pair[k], first_pair[k + 1]):
            for e in range(10):
                out[m, e] += pairs[p, e]


@njit(cache=True, parallel=True, nogil=True)
def weigh_tiles(splats, offsets, members, pair_of, tiles_x, width, height, out):
    """Largest and summed weight of every (tile, splat) pair into out (P, 2) float32."""
    tiles = len(offsets) - 1
    for i in prange(tiles):
        tile = _spread(i, tiles)
        left, top = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        state, rows, _ = _open_tile(left, top, width, height)
        low, high = 0, rows
        for k in range(offsets[tile], offsets[tile + 1]):
            out[pair_of[k], 0] = 0.0
            out[pair_of[k], 1] = 0.0
        for k in range(offsets[tile], offsets[tile + 1]):
            polynomial, start, stop, _ = _in_tile(splats[members[k]], left, top)
            largest, total = weigh(state, polynomial, max(start, low), min(stop, high))
            out[pair_of[k], 0] = largest
            out[pair_of[k], 1] = total
            if (k - offsets[tile]) % _CHECK_EVERY == _CHECK_EVERY - 1:
                low, high = _lit_rows(state, low, high)
                if low >= high:
                    break
