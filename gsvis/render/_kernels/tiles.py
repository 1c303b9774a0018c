"""Kernels that blend the lists of tiles, forward and backward.

A tile is 16 x 16 pixels; its list holds the splats that reach alpha 1/255 at one of its pixel centers, front to back.
Threads take tiles as they come free. Lists, images and gradients do not depend on the number of threads.
"""

from __future__ import annotations

import numpy as np

from gsvis._kernels.compiled import inner, kernel, njit, uncounted
from gsvis._kernels.prefetch import prefetch
from gsvis._kernels.shared import take_next
from gsvis._kernels.threads import in_parts, in_threads
from gsvis.render._kernels.backward import blend_backward, take_out
from gsvis.render._kernels.forward import blend, list_by_block, take_weight, weigh
from gsvis.render._kernels.lanes import (
    BATCH,
    BLOCKS,
    CENTER_X,
    CENTER_Y,
    CHANNELS,
    LANES,
    PLACE,
    RECORD,
    SIDE,
    TILE,
    find_reached_blocks,
)


@inner
def allocate(count):
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
        splats (BATCH + 1, RECORD), of which the last reaches nothing, and for the blocks that they reach (BATCH,); and
        the blocks with light left (1,).
    """
    left = (tile % tiles_x) * TILE
    top = (tile // tiles_x) * TILE
    rows = min(TILE, height - top)
    columns = min(TILE, width - left)
    state = allocate(np.int64(BLOCKS * CHANNELS * LANES)).reshape((BLOCKS, CHANNELS, LANES))
    gates = allocate(np.int64(BLOCKS))
    lit = np.zeros(1, np.int64)
    gates[:] = -1.0
    for r in range(rows):
        for k in range(columns):
            block, lane = find_lane(r, k)
            state[block, 0, lane] = 1.0
            gates[block] = np.inf
            lit[0] |= 1 << block
    records = allocate(np.int64((BATCH + 1) * RECORD)).reshape((BATCH + 1, RECORD))
    records[BATCH, 0] = -1e9
    todo = np.empty(BATCH, np.int64)
    first = offsets[tile]
    total = offsets[tile + 1] - offsets[tile]
    return (left, top, rows, columns), (first, total), (state, gates, records, todo, lit)


@uncounted
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
    records[j, CENTER_X] = x
    records[j, CENTER_Y] = y


@uncounted
def prepare(splats, features, members, first, place, count, left, top, gates, records, todo):
    """Write the records and reached blocks of `count` splats of a tile's list; the list starts at `first`."""
    for j in range(count):
        m = np.int64(members[first + place + j])
        prefetch(splats, 8 * m)
        prefetch(features, 4 * m)
    for j in range(count):
        m = members[first + place + j]
        _shape(splats, m, left, top, records, j)
        for e in range(4):
            records[j, 6 + e] = features[m, e]
        records[j, PLACE] = place + j + 1
    records[BATCH, PLACE] = place + count
    for j in range(count):
        todo[j] = find_reached_blocks(records, j, gates, np.float32(place + j))


@uncounted
def prepare_shapes(splats, members, first, place, count, left, top, gates, records, todo):
    """Do what `prepare` does for splats without features, whose weights alone matter."""
    for j in range(count):
        m = np.int64(members[first + place + j])
        prefetch(splats, 8 * m)
    for j in range(count):
        _shape(splats, members[first + place + j], left, top, records, j)
    for j in range(count):
        todo[j] = find_reached_blocks(records, j, gates, np.float32(place + j))


@uncounted
def call_up(out, pair_of, start, count):
    """Let the rows of `count` pairs come into the cache, before they are written: neighbors in a list lie far apart."""
    columns = out.shape[1]
    for k in range(start, start + count):
        prefetch(out, columns * np.int64(pair_of[k]))


@uncounted
def _blend_some(state, records, by_block, lit):
    """Blend prepared Gaussians into the lit blocks that they reach."""
    for block in range(BLOCKS):
        if by_block[block] and (lit[0] >> block) & 1:
            blend(state, block, records, by_block[block], lit)


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
    by_block = np.empty(BLOCKS, np.int64)
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
            list_by_block(todo, count, by_block)
            _blend_some(state, records, by_block, lit)
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
                median[y, x] = state[block, 5, lane] if left_over <= 0.5 else np.float32(0.0)
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
            call_up(out, pair_of, first + start, stop - start)
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


@uncounted
def weigh_some(state, records, by_block, lit, sums):
    """Weigh prepared Gaussians at the lit blocks that they reach; `sums` (BATCH + 1, 2, LANES) is that of `weigh`."""
    for block in range(BLOCKS):
        if by_block[block] and (lit[0] >> block) & 1:
            weigh(state, block, records, by_block[block], lit, sums)


@in_threads(lambda splats, offsets, *_: len(offsets) - 1)
@kernel(error_model="numpy")
def weigh_tiles(taken, splats, offsets, members, pair_of, tiles_x, width, height, out):
    """Write the largest and summed weight of every (tile, splat) pair into out (P, 2) float32."""
    tiles = len(offsets) - 1
    by_block = np.empty(BLOCKS, np.int64)
    sums = allocate(np.int64((BATCH + 1) * 2 * LANES)).reshape((BATCH + 1, 2, LANES))
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
            list_by_block(todo, count, by_block)
            call_up(out, pair_of, first + start, count)
            weigh_some(state, records, by_block, lit, sums)
            for j in range(count):
                largest, total_weight = take_weight(sums, j)
                out[pair_of[first + start + j], 0] = largest
                out[pair_of[first + start + j], 1] = total_weight
        tile = take_next(taken)
