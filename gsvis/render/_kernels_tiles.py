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
_MARGIN = 1e-3  # pixels; a tile too many costs little, one too few an edge


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
def _span(splat, low, high):
    """Least and largest x at which the splat reaches alpha 1/255 between the lines y = low and y = high.

    The right side of an ellipse bulges most where its bounding box touches it, the left side opposite; on a band that
    does not hold that height, it reaches furthest at the nearer line.
    """
    a, b, c = -splat[2], -splat[3], -splat[4]
    level = splat[5] + _LOG2_255
    bulge = -b * splat[6] / (2.0 * c)
    low, high = max(low - splat[1], -splat[7]), min(high - splat[1], splat[7])
    right, left = min(max(bulge, low), high), min(max(-bulge, low), high)
    furthest = np.sqrt(max(b * b * right * right - 4.0 * a * (c * right * right - level), 0.0))
    nearest = np.sqrt(max(b * b * left * left - 4.0 * a * (c * left * left - level), 0.0))
    return splat[0] + (-b * left - nearest) / (2.0 * a), splat[0] + (-b * right + furthest) / (2.0 * a)


@njit(cache=True)
def _tiles_between(low, high, tiles):
    """First and last of `tiles` tiles along an axis with a pixel centre in [low, high]."""
    return max(int(np.ceil((low + 0.5) / TILE)) - 1, 0), min(int(np.floor((high - 0.5) / TILE)), tiles - 1)


@njit(cache=True, parallel=True, nogil=True)
def count_candidates(splats, tiles_x, tiles_y, out):
    """Tiles under the box of each splat into out (M,)."""
    for m in prange(len(splats)):
        splat = splats[m]
        x0, x1 = _tiles_between(splat[0] - splat[6], splat[0] + splat[6], tiles_x)
        y0, y1 = _tiles_between(splat[1] - splat[7], splat[1] + splat[7], tiles_y)
        out[m] = max(x1 - x0 + 1, 0) * max(y1 - y0 + 1, 0)


@njit(cache=True, parallel=True, nogil=True)
def meet_tiles(splats, order, first_room, tiles_x, tiles_y, met, counts, histogram):
    """Tiles that each splat reaches, splat k of the depth order from met[first_room[k]] on, counts[k] of them.

    `histogram` (chunks, tiles) receives how many splats each chunk of the order puts into each tile.
    """
    chunks = len(histogram)
    for chunk in prange(chunks):
        for k in range(len(order) * chunk // chunks, len(order) * (chunk + 1) // chunks):
            splat = splats[order[k]]
            x0, x1 = _tiles_between(splat[0] - splat[6], splat[0] + splat[6], tiles_x)
            y0, y1 = _tiles_between(splat[1] - splat[7], splat[1] + splat[7], tiles_y)
            at = first_room[k]
            for ty in range(y0, y1 + 1):
                first, last = x0, x1
                if x0 < x1 and y0 < y1:  # else the box touches just the tiles the ellipse does
                    low, high = _span(splat, ty * TILE + 0.5, ty * TILE + TILE - 0.5)
                    first, last = _tiles_between(low - _MARGIN, high + _MARGIN, tiles_x)
                    first, last = max(x0, first), min(x1, last)
                for tx in range(first, last + 1):
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
    """Polynomial over the tile's pixels, and the centre from the first of them."""
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
    return polynomial, (np.float32(x), np.float32(y))


@njit(cache=True)
def _open_tile(left, top, width, height):
    """Fresh state: light everywhere inside the image, none outside, nothing blended.

    Returns the state, aligned to cache lines, and the rows and columns inside the image.
    """
    size = (TILE + 1) * CHANNELS * TILE
    room = np.zeros(size + 16, np.float32)
    first = (-room.ctypes.data % 64) // 4
    state = room[first : first + size].reshape((TILE + 1, CHANNELS, TILE))
    state[TILE, 0] = -1.0
    rows = min(TILE, height - top)
    columns = min(TILE, width - left)
    for r in range(rows):
        state[TILE, 0, r] = np.inf
        for k in range(columns):
            state[r, 0, k] = 1.0
        for k in range(TILE):
            state[r, 6, k] = np.inf
    return state, rows, columns


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
def blend_tiles(splats, features, offsets, members, tiles_x, background, image, transmittance, depth, median, stop_at):
    """Render all tiles. `features` is (M, 4) float32: colour and depth. Outputs are (H, W, ...)."""
    height, width = transmittance.shape
    tiles = len(offsets) - 1
    for i in prange(tiles):
        tile = _spread(i, tiles)
        left, top = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        state, rows, columns = _open_tile(left, top, width, height)
        for k in range(offsets[tile], offsets[tile + 1]):
            m = members[k]
            polynomial, _ = _in_tile(splats[m], left, top)
            feature = (features[m, 0], features[m, 1], features[m, 2], features[m, 3])
            if blend(state, polynomial, feature, np.float32(k - offsets[tile])) == 0:
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
                stop_at[y, x] = state[r, 6, k]


@njit(cache=True, parallel=True, nogil=True)
def blend_tiles_backward(splats, features, offsets, members, pair_of, tiles_x, background, forward, gradients, out):
    """Gradient sums of every (tile, splat) pair into out (P, 10) float32; see `blend_backward`.

    `forward` is (transmittance, depth, stop_at); `gradients` is by (image, alpha, depth).
    """
    transmittance, depth, stop_at = forward
    v_image, v_alpha, v_depth = gradients
    height, width = transmittance.shape
    tiles = len(offsets) - 1
    for i in prange(tiles):
        tile = _spread(i, tiles)
        left, top = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        state, rows, columns = _open_tile(left, top, width, height)
        newest = np.float32(-1.0)
        for r in range(rows):
            state[TILE, 0, r] = -1.0
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
                state[r, 6, k] = stop_at[y, x]
                state[TILE, 0, r] = max(state[TILE, 0, r], stop_at[y, x])
            newest = max(newest, state[TILE, 0, r])
        count = offsets[tile + 1] - offsets[tile]
        reached = int(min(np.float64(newest), np.float64(count)))  # no pixel goes beyond
        for k in range(offsets[tile] + reached, offsets[tile + 1]):
            for e in range(10):
                out[pair_of[k], e] = 0.0
        for place in range(reached - 1, -1, -1):
            k = offsets[tile] + place
            m = members[k]
            polynomial, centre = _in_tile(splats[m], left, top)
            feature = (features[m, 0], features[m, 1], features[m, 2], features[m, 3])
            sums = blend_backward(state, polynomial, feature, centre, np.float32(place))
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
        state, _, _ = _open_tile(left, top, width, height)
        for k in range(offsets[tile], offsets[tile + 1]):
            out[pair_of[k], 0] = 0.0
            out[pair_of[k], 1] = 0.0
        for k in range(offsets[tile], offsets[tile + 1]):
            polynomial, _ = _in_tile(splats[members[k]], left, top)
            largest, total, lit = weigh(state, polynomial)
            if lit == 0.0:
                break
            out[pair_of[k], 0] = largest
            out[pair_of[k], 1] = total
