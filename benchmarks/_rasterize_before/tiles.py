"""Kernels that sort projected Gaussians into tiles and blend the tiles. As at commit 70806c2.

A tile is 16 x 16 pixels; its list holds the splats that reach alpha 1/255 at one of its pixel centers, front to back.
Lists and images do not depend on the number of threads.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from .lanes import CHANNELS, LANES, RECORD, blend, reached_rows

TILE = LANES
_LOG2_255 = 7.994353436858858
_BATCH = 32  # Gaussians made ready at a time
_MARGIN = 1e-3  # pixels; a tile too many costs little, one too few an edge


@njit(cache=True)
def _row_order(rows, i, j):
    """-1, 0 or 1 as row i of an array of two dimensions sorts before, with or after row j."""
    for c in range(rows.shape[1]):
        if rows[i, c] != rows[j, c]:
            return -1 if rows[i, c] < rows[j, c] else 1
    return 0


@njit(cache=True)
def _less(i, j, ids, means, scales, quats, opacities, sh0):
    """Content order of two splats of equal depth: means, scales, quats, opacity, color."""
    i, j = ids[i], ids[j]
    for rows in (means, scales, quats, opacities, sh0):
        sign = _row_order(rows, i, j)
        if sign != 0:
            return sign < 0
    return False


@njit(cache=True)
def order_ties(order, depths, ids, means, scales, quats, opacities, sh0):
    """Put runs of equal depth in a depth order into content order (merge sort).

    `depths` are in that order already; all content is (N, columns).
    """
    scratch = np.empty_like(order)
    start = 0
    while start < len(order):
        stop = start + 1
        while stop < len(order) and depths[stop] == depths[start]:
            stop += 1
        width = 1
        while width < stop - start:
            for left in range(start, stop, 2 * width):
                middle, right = min(left + width, stop), min(left + 2 * width, stop)
                i, j = left, middle
                for k in range(left, right):
                    take_left = i < middle
                    if take_left and j < right:
                        take_left = not _less(order[j], order[i], ids, means, scales, quats, opacities, sh0)
                    if take_left:
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
    """First and last of `tiles` tiles along an axis with a pixel center in [low, high]."""
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
def _aligned(count):
    """Room for `count` float32 zeros that starts on a cache line."""
    room = np.zeros(count + 16, np.float32)
    first = (-room.ctypes.data % 64) // 4
    return room[first : first + count]


@njit(cache=True)
def _open_tile(left, top, width, height):
    """Fresh state: light everywhere inside the image, none outside, nothing blended.

    Returns the state, the gates of its rows, and the rows and columns inside the image.
    """
    state = _aligned(TILE * CHANNELS * TILE).reshape((TILE, CHANNELS, TILE))
    gates = _aligned(TILE)
    rows = min(TILE, height - top)
    columns = min(TILE, width - left)
    gates[:rows] = np.inf
    gates[rows:] = -1.0
    for r in range(rows):
        for k in range(columns):
            state[r, 0, k] = 1.0
        for k in range(TILE):
            state[r, 6, k] = np.inf
    return state, gates, rows, columns


@njit(cache=True)
def _prepare(splats, features, members, first, place, count, left, top, gates, records, todo):
    """Records and rows of `count` Gaussians of a tile's list that starts at `first`, from `place` on."""
    for j in range(count):
        m = members[first + place + j]
        x, y = splats[m, 0] - (left + 0.5), splats[m, 1] - (top + 0.5)
        a, b, c = splats[m, 2], splats[m, 3], splats[m, 4]
        records[j, 0] = splats[m, 5] + a * x * x + b * x * y + c * y * y
        records[j, 1] = -(2.0 * a * x + b * y)
        records[j, 2] = -(2.0 * c * y + b * x)
        records[j, 3], records[j, 4], records[j, 5] = a, b, c
        for e in range(4):
            records[j, 6 + e] = features[m, e]
        records[j, 10], records[j, 11] = x, y
    for j in range(count):
        todo[j] = reached_rows(records, j, gates, np.float32(place + j))


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
    """Render all tiles. `features` is (M, 4) float32: color and depth. Outputs are (H, W, ...)."""
    height, width = transmittance.shape
    tiles = len(offsets) - 1
    for i in prange(tiles):
        tile = _spread(i, tiles)
        left, top = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        state, gates, rows, columns = _open_tile(left, top, width, height)
        records, todo = _aligned(_BATCH * RECORD).reshape((_BATCH, RECORD)), np.empty(_BATCH, np.int64)
        lit = np.full(1, (1 << rows) - 1)
        first, total = offsets[tile], offsets[tile + 1] - offsets[tile]
        for start in range(0, total, _BATCH):
            if lit[0] == 0:
                break
            count = min(_BATCH, total - start)
            _prepare(splats, features, members, first, start, count, left, top, gates, records, todo)
            for j in range(count):
                blend(state, records, j, todo[j] & lit[0], lit, np.float32(start + j))
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
