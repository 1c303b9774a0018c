"""Kernels that sort projected Gaussians into tiles and blend the tiles, forward and backward.

A tile is 16 x 16 pixels; its list holds the splats that reach alpha 1/255 at one of its pixel centers, front to back.
Threads take tiles as they come free. Lists, images and gradients do not depend on the number of threads.
"""

from __future__ import annotations

import numpy as np

from gsvis._kernels.compiled import inner, kernel, njit, uncounted
from gsvis._kernels.prefetch import prefetch
from gsvis._kernels.shared import share, take_next
from gsvis._kernels.threads import in_parts, in_threads, on_numba_threads
from gsvis.render._kernels.lanes import (
    BLOCKS,
    CHANNELS,
    LANES,
    LOG2_255,
    RECORD,
    SIDE,
    TILE,
    blend,
    blend_backward,
    find_reached_blocks,
    take_out,
    weigh,
)

BLOCK = 1 << 11  # splats that one thread takes at a time
BATCH = 32  # Gaussians prepared at a time
_MARGIN = 1e-3  # pixels; a surplus tile costs little, a missing tile shows as an edge


@uncounted(error_model="numpy")
def _outline(splat):
    """Return numbers of the ellipse on which a splat has alpha 1/255, for `_span`.

    With d = pixel - center, it is a dx^2 + b dx dy + c dy^2 = level. Returns the dy at which its right side bulges
    most, 1 / 2a, b, b^2 - 4ac and 4a level.
    """
    a = -splat[2]
    b = -splat[3]
    c = -splat[4]
    return -b * splat[6] / (2.0 * c), 0.5 / a, b, b * b - 4.0 * a * c, 4.0 * a * (splat[5] + LOG2_255)


@uncounted
def _span(splat, outline, low, high):
    """Return the least and largest x at which the splat reaches alpha 1/255 between the lines y = low and y = high.

    The right side of an ellipse bulges most where its bounding box touches it, the left side opposite; on a band that
    does not hold that height, it reaches furthest at the nearer line.
    """
    bulge, half, b, narrowing, widest = outline
    low = max(low - splat[1], -splat[7])
    high = min(high - splat[1], splat[7])
    right = min(max(bulge, low), high)
    left = min(max(-bulge, low), high)
    furthest = np.sqrt(max(narrowing * right * right + widest, 0.0))
    nearest = np.sqrt(max(narrowing * left * left + widest, 0.0))
    return splat[0] - half * (b * left + nearest), splat[0] - half * (b * right - furthest)


@uncounted
def _tiles_between(low, high, tiles):
    """Return the first and last of `tiles` tiles along an axis with a pixel center in [low, high]."""
    return max(int(np.ceil((low + 0.5) / TILE)) - 1, 0), min(int(np.floor((high - 0.5) / TILE)), tiles - 1)


@uncounted
def _box(splat, tiles_x, tiles_y):
    """Return the first and last column, and the first and last row, of the tiles under the box of a splat."""
    x0, x1 = _tiles_between(splat[0] - splat[6], splat[0] + splat[6], tiles_x)
    y0, y1 = _tiles_between(splat[1] - splat[7], splat[1] + splat[7], tiles_y)
    return x0, x1, y0, y1


@uncounted
def _count_under_boxes(block, splats, tiles_x, tiles_y, out):
    """Count the tiles under the boxes of the splats of one block."""
    total = 0
    for m in range(block * BLOCK, min(len(splats), (block + 1) * BLOCK)):
        x0, x1, y0, y1 = _box(splats[m], tiles_x, tiles_y)
        total += max(x1 - x0 + 1, 0) * max(y1 - y0 + 1, 0)
    out[block] = total


@on_numba_threads
@kernel
def count_candidates(splats, tiles_x, tiles_y, out):
    """Write the number of tiles under the boxes of the splats of each block into out (blocks,)."""
    share(_count_under_boxes, len(out), (splats, tiles_x, tiles_y, out))


@uncounted(error_model="numpy")
def _meet_block(block, splats, room, tiles_x, tiles_y, met, spans):
    """Write the tiles that the splats of one block reach; see `meet_tiles`."""
    at = np.int64(0)
    for m in range(block * BLOCK, min(len(splats), (block + 1) * BLOCK)):
        splat = splats[m]
        x0, x1, y0, y1 = _box(splat, tiles_x, tiles_y)
        outline = _outline(splat)
        spans[m, 0] = at
        for ty in range(y0, y1 + 1):
            first = x0
            last = x1
            if x0 < x1 and y0 < y1:  # else the box touches just the tiles the ellipse does
                low, high = _span(splat, outline, ty * TILE + 0.5, ty * TILE + TILE - 0.5)
                first, last = _tiles_between(low - _MARGIN, high + _MARGIN, tiles_x)
                first = max(x0, first)
                last = min(x1, last)
            for tx in range(first, last + 1):
                met[room[block] + at] = ty * tiles_x + tx
                at += 1
        spans[m, 1] = at - spans[m, 0]


@on_numba_threads
@kernel
def meet_tiles(splats, room, tiles_x, tiles_y, met, spans):
    """Write the tiles that each splat reaches into met; those of block b start at room[b].

    spans (M, 2) receives the start of each splat's tiles, counted from room[b], and their number.
    """
    share(_meet_block, len(room) - 1, (splats, room, tiles_x, tiles_y, met, spans))


@uncounted
def _find_met(order, start, count, spans, room, met, found):
    """Write the start of a splat's tiles, their number and the first tile into found (K, 3), for `count` splats.

    Handling many splats at a time lets the loads from memory overlap.
    """
    for j in range(count):
        m = order[start + j]
        found[j, 0], found[j, 1] = room[m // BLOCK] + spans[m, 0], spans[m, 1]
    for j in range(count):
        found[j, 2] = met[found[j, 0]]


@inner(error_model="numpy")
def _count_chunk(chunk, order, spans, room, met, counts, pairs):
    """Count the splats of one chunk in each tile; see `count_tiles`."""
    chunks = len(counts)
    found = np.empty((BATCH, 3), np.int64)
    total = 0
    last = len(order) * (chunk + 1) // chunks
    for start in range(len(order) * chunk // chunks, last, BATCH):
        count = min(BATCH, last - start)
        _find_met(order, start, count, spans, room, met, found)
        for j in range(count):
            if found[j, 1] > 0:
                counts[chunk, found[j, 2]] += 1
            for i in range(1, found[j, 1]):
                counts[chunk, met[found[j, 0] + i]] += 1
            total += found[j, 1]
    pairs[chunk] = total


@on_numba_threads
@kernel
def count_tiles(order, spans, room, met, counts, pairs):
    """Count how many splats each chunk of the depth order puts into each tile: counts (chunks, tiles).

    `pairs` (chunks,) receives the sums.
    """
    share(_count_chunk, len(counts), (order, spans, room, met, counts, pairs))


@inner(error_model="numpy")
def _fill_chunk(chunk, order, spans, room, met, places, first_pair, members, pair_of):
    """Write the splats of one chunk into the tiles' lists; see `fill_tiles`."""
    chunks = len(places)
    found = np.empty((BATCH, 3), np.int64)
    first = len(order) * chunk // chunks
    last = len(order) * (chunk + 1) // chunks
    pair = first_pair[first]
    for start in range(first, last, BATCH):
        count = min(BATCH, last - start)
        _find_met(order, start, count, spans, room, met, found)
        for j in range(count):
            first_pair[start + j] = pair
            tile = found[j, 2]
            for i in range(found[j, 1]):
                if i > 0:
                    tile = met[found[j, 0] + i]
                place = places[chunk, tile]
                places[chunk, tile] = place + 1
                members[place] = order[start + j]
                if len(pair_of):
                    pair_of[place] = pair
                pair += 1


@on_numba_threads
@kernel
def fill_tiles(order, spans, room, met, places, first_pair, members, pair_of):
    """Write each tile's list, front to back, from places (chunks, tiles) on, which are counted up.

    `pair_of` (may be empty) numbers the pairs along the depth order: splat order[k] owns those from first_pair[k] on,
    of which the first of each chunk is given, and the others are filled in.
    """
    share(_fill_chunk, len(places), (order, spans, room, met, places, first_pair, members, pair_of))


@inner
def _allocate(count):
    """Return `count` float32 zeros that start on a cache line."""
    room = np.zeros(count + 16, np.float32)
    first = (-room.ctypes.data % 64) // 4
    return room[first : first + count]


@uncounted
def find_lane(row, column):
    """Return the block and the lane, in the state of a tile, of the pixel in a row and a column of the tile."""
    block = row // SIDE * SIDE + column // SIDE
    return block, row % SIDE * SIDE + column % SIDE


@njit(cache=True)
def open_tile(tile, offsets, tiles_x, width, height):
    """Return where a tile lies, where its list is, and what it is drawn with.

    Returns:
        The first column, the first row, and the numbers of rows and columns inside the image. Then the place of the
        list among the members, and its length. Then five arrays: the state (BLOCKS, CHANNELS, LANES), with full light
        inside the image, none outside, and nothing blended; the gates (BLOCKS,); room for the records of prepared
        splats (BATCH, RECORD) and for the blocks that they reach (BATCH,); and the blocks with light left (1,).
    """
    left = (tile % tiles_x) * TILE
    top = (tile // tiles_x) * TILE
    rows = min(TILE, height - top)
    columns = min(TILE, width - left)
    state = _allocate(np.int64(BLOCKS * CHANNELS * LANES)).reshape((BLOCKS, CHANNELS, LANES))
    gates = _allocate(np.int64(BLOCKS))
    lit = np.zeros(1, np.int64)
    gates[:] = -1.0
    for block in range(BLOCKS):
        for lane in range(LANES):
            state[block, 6, lane] = np.inf
    for r in range(rows):
        for k in range(columns):
            block, lane = find_lane(r, k)
            state[block, 0, lane] = 1.0
            gates[block] = np.inf
            lit[0] |= 1 << block
    records = _allocate(np.int64(BATCH * RECORD)).reshape((BATCH, RECORD))
    todo = np.empty(BATCH, np.int64)
    first = offsets[tile]
    total = offsets[tile + 1] - offsets[tile]
    return (left, top, rows, columns), (first, total), (state, gates, records, todo, lit)


@inner
def _shape(splats, m, left, top, records, j):
    """Write the shape of splat m, from the first pixel of a tile, into record j."""
    x = splats[m, 0] - (left + 0.5)
    y = splats[m, 1] - (top + 0.5)
    a = splats[m, 2]
    b = splats[m, 3]
    c = splats[m, 4]
    records[j, 0] = splats[m, 5] + a * x * x + b * x * y + c * y * y
    records[j, 1] = -(2.0 * a * x + b * y)
    records[j, 2] = -(2.0 * c * y + b * x)
    records[j, 3] = a
    records[j, 4] = b
    records[j, 5] = c
    records[j, 10] = x
    records[j, 11] = y


@uncounted
def prepare(splats, features, members, first, place, count, left, top, gates, records, todo):
    """Write the records and reached blocks of `count` splats of a tile's list; the list starts at `first`."""
    for j in range(count):
        m = np.int64(members[first + place + j])
        prefetch(splats, 8 * m)
        prefetch(splats, 8 * m + 7)
        prefetch(features, 4 * m)
    for j in range(count):
        m = members[first + place + j]
        _shape(splats, m, left, top, records, j)
        for e in range(4):
            records[j, 6 + e] = features[m, e]
    for j in range(count):
        todo[j] = find_reached_blocks(records, j, gates, np.float32(place + j))


@uncounted
def prepare_shapes(splats, members, first, place, count, left, top, gates, records, todo):
    """Do what `prepare` does for splats without features, whose weights alone matter."""
    for j in range(count):
        m = np.int64(members[first + place + j])
        prefetch(splats, 8 * m)
        prefetch(splats, 8 * m + 7)
    for j in range(count):
        _shape(splats, members[first + place + j], left, top, records, j)
    for j in range(count):
        todo[j] = find_reached_blocks(records, j, gates, np.float32(place + j))


@in_threads(lambda splats, features, offsets, *_: len(offsets) - 1)
@kernel(error_model="numpy")
def blend_tiles(
    taken,
    splats,
    features,
    offsets,
    members,
    tiles_x,
    background,
    image,
    transmittance,
    depth,
    median,
    stop_at,
):
    """Render all tiles. `features` is (M, 4) float32: color and depth. Outputs are (H, W, ...)."""
    height, width = transmittance.shape
    tiles = len(offsets) - 1
    tile = take_next(taken)
    while tile < tiles:
        place, (first, total), room = open_tile(tile, offsets, tiles_x, width, height)
        left, top, rows, columns = place
        state, gates, records, todo, lit = room
        for start in range(0, total, BATCH):
            if lit[0] == 0:
                break
            count = min(BATCH, total - start)
            prepare(splats, features, members, first, start, count, left, top, gates, records, todo)
            for j in range(count):
                blend(state, records, j, todo[j] & lit[0], lit, np.float32(start + j))
        for r in range(rows):
            for k in range(columns):
                block, lane = find_lane(r, k)
                left_over = abs(state[block, 0, lane])
                y = top + r
                x = left + k
                transmittance[y, x] = left_over
                for c in range(3):
                    image[y, x, c] = state[block, 1 + c, lane] + left_over * background[c]
                covered = np.float32(1.0) - left_over
                depth[y, x] = state[block, 4, lane] / covered if covered > 0.0 else np.float32(0.0)
                median[y, x] = state[block, 5, lane]
                stop_at[y, x] = state[block, 6, lane]
        tile = take_next(taken)


@in_threads(lambda splats, features, offsets, *_: len(offsets) - 1)
@kernel(error_model="numpy")
def blend_tiles_backward(
    taken,
    splats,
    features,
    offsets,
    members,
    pair_of,
    tiles_x,
    background,
    forward,
    gradients,
    still,
    out,
):
    """Write the gradient sums of every (tile, splat) pair into out (P, 12) float32; see `blend_backward`.

    `forward` is (transmittance, depth, stop_at); `gradients` is by (image, alpha, depth). Pairs of the first `still`
    splats get none.
    """
    transmittance, depth, stop_at = forward
    v_image, v_alpha, v_depth = gradients
    height, width = transmittance.shape
    tiles = len(offsets) - 1
    tile = take_next(taken)
    while tile < tiles:
        place, (first, total), room = open_tile(tile, offsets, tiles_x, width, height)
        left, top, rows, columns = place
        state, gates, records, todo, _ = room
        gates[:] = -1.0
        for r in range(rows):
            for k in range(columns):
                block, lane = find_lane(r, k)
                y = top + r
                x = left + k
                t = transmittance[y, x]
                covered = np.float32(1.0) - t
                state[block, 0, lane] = t
                by_t = -v_alpha[y, x]
                for c in range(3):
                    state[block, 1 + c, lane] = v_image[y, x, c]
                    by_t += v_image[y, x, c] * background[c]
                if covered > 0.0:  # depth = sum(w z) / covered
                    state[block, 4, lane] = v_depth[y, x] / covered
                    by_t += v_depth[y, x] * depth[y, x] / covered
                state[block, 5, lane] = t * by_t
                state[block, 6, lane] = stop_at[y, x]
                gates[block] = max(gates[block], stop_at[y, x])
        reached = int(min(np.float64(gates.max()), np.float64(total)))  # no pixel goes beyond
        for k in range(first + reached, first + total):
            if members[k] >= still:
                for e in range(10):
                    out[pair_of[k], e] = 0.0
        for stop in range(reached, 0, -BATCH):
            start = max(stop - BATCH, 0)
            prepare(splats, features, members, first, start, stop - start, left, top, gates, records, todo)
            for j in range(stop - start - 1, -1, -1):
                at = np.float32(start + j)
                if members[first + start + j] < still:
                    take_out(state, records, j, todo[j], at)
                else:
                    blend_backward(state, records, j, todo[j], at, out, np.int64(pair_of[first + start + j]))
        tile = take_next(taken)


@in_parts(lambda order, *_: len(order))
@kernel(error_model="numpy")
def sum_pairs(begin, end, order, first_pair, pairs, still, out):
    """Sum the pairs of each splat but the first `still`, in the order of its tiles: out (M, 10) float64."""
    for k in range(begin, end):
        m = order[k]
        if m < still:
            continue
        for e in range(10):
            out[m, e] = 0.0
        for p in range(first_pair[k], first_pair[k + 1]):
            for e in range(10):
                out[m, e] += pairs[p, e]


@in_parts(lambda order, *_: len(order))
@kernel(error_model="numpy")
def join_weights(begin, end, order, ids, first_pair, pairs, largest, summed):
    """Write the largest and the summed weight of each Gaussian with a pair into largest (N,) and summed (N,)."""
    for k in range(begin, end):
        if first_pair[k] == first_pair[k + 1]:
            continue
        most = np.float32(0.0)
        total = 0.0
        for p in range(first_pair[k], first_pair[k + 1]):
            most = max(most, pairs[p, 0])
            total += pairs[p, 1]
        i = ids[order[k]]
        largest[i] = most
        summed[i] = total


@in_threads(lambda splats, offsets, *_: len(offsets) - 1)
@kernel(error_model="numpy")
def weigh_tiles(taken, splats, offsets, members, pair_of, tiles_x, width, height, out):
    """Write the largest and summed weight of every (tile, splat) pair into out (P, 2) float32."""
    tiles = len(offsets) - 1
    tile = take_next(taken)
    while tile < tiles:
        place, (first, total), room = open_tile(tile, offsets, tiles_x, width, height)
        left, top, _, _ = place
        state, gates, records, todo, lit = room
        for k in range(first, first + total):
            out[pair_of[k], 0] = 0.0
            out[pair_of[k], 1] = 0.0
        for start in range(0, total, BATCH):
            if lit[0] == 0:
                break
            count = min(BATCH, total - start)
            prepare_shapes(splats, members, first, start, count, left, top, gates, records, todo)
            for j in range(count):
                largest, total_weight = weigh(state, records, j, todo[j] & lit[0], lit)
                out[pair_of[first + start + j], 0] = largest
                out[pair_of[first + start + j], 1] = total_weight
        tile = take_next(taken)
