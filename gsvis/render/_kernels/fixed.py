"""Kernels for views of Gaussians whose geometry stays: which of them a view blends, and gradients by their colors.

Threads take tiles as they come free. Results do not depend on the number of threads.
"""

from __future__ import annotations

import numpy as np

from gsvis._kernels.compiled import kernel, uncounted
from gsvis._kernels.shared import take_next
from gsvis._kernels.threads import in_parts, in_threads
from gsvis.render._kernels.forward import gather, list_by_block, take_sums, take_weight
from gsvis.render._kernels.lanes import BATCH, BLOCKS, LANES
from gsvis.render._kernels.tiles import allocate, call_up, find_lane, open_tile, prepare_shapes, weigh_some

__all__ = ["gather_tiles", "mark_blended", "sum_shares"]


@in_threads(lambda splats, offsets, *_: len(offsets) - 1)
@kernel(error_model="numpy")
def mark_blended(taken, splats, offsets, members, tiles_x, width, height, marks):
    """Write 1 into marks (M,) uint8 for each splat with a weight above 0 at a pixel.

    Args:
        taken: Counter of `take_next`; the caller leaves it out.
        splats: (M, 8) float64, see `_kernels.project`.
        offsets: (tiles + 1,) int64, the list of each tile.
        members: (P,) int32, the splats of the lists, front to back.
        tiles_x: Number of tiles across.
        width: Pixels.
        height: Pixels.
        marks: (M,) uint8, zeros.
    """
    tiles = len(offsets) - 1
    by_block = np.empty(BLOCKS, np.int64)
    sums = allocate(np.int64((BATCH + 1) * 2 * LANES)).reshape((BATCH + 1, 2, LANES))
    tile = take_next(taken)
    while tile < tiles:
        place, (first, total), room = open_tile(tile, offsets, tiles_x, width, height)
        left, top, _, _ = place
        state, gates, records, todo, lit = room
        for start in range(0, total, BATCH):
            if lit[0] == 0:
                break
            count = min(BATCH, total - start)
            prepare_shapes(splats, members, first, start, count, left, top, gates, records, todo)
            list_by_block(todo, count, by_block)
            weigh_some(state, records, by_block, lit, sums)
            for j in range(count):
                largest, _ = take_weight(sums, j)
                if largest > 0.0:
                    marks[members[first + start + j]] = 1  # threads write the same value
        tile = take_next(taken)


@uncounted
def _gather_some(state, records, by_block, lit, sums):
    """Gather for prepared Gaussians at the lit blocks that they reach; `sums` (BATCH + 1, 3, LANES) is `gather`'s."""
    for block in range(BLOCKS):
        if by_block[block] and (lit[0] >> block) & 1:
            gather(state, block, records, by_block[block], lit, sums)


@in_threads(lambda splats, offsets, *_: len(offsets) - 1)
@kernel(error_model="numpy")
def gather_tiles(taken, splats, offsets, members, pair_of, tiles_x, v_image, out):
    """Write the gradient by the color of every (tile, splat) pair into out (P, 4) float32; the last is 0.

    Args:
        taken: Counter of `take_next`; the caller leaves it out.
        splats: (M, 8) float64.
        offsets: (tiles + 1,) int64, the list of each tile.
        members: (P,) int32, the splats of the lists, front to back.
        pair_of: (P,) int32, the number of each pair.
        tiles_x: Number of tiles across.
        v_image: (H, W, 3) float32, gradient of a loss by the image.
        out: (P, 4) float32.
    """
    height, width, _ = v_image.shape
    tiles = len(offsets) - 1
    by_block = np.empty(BLOCKS, np.int64)
    sums = allocate(np.int64((BATCH + 1) * 3 * LANES)).reshape((BATCH + 1, 3, LANES))
    tile = take_next(taken)
    while tile < tiles:
        place, (first, total), room = open_tile(tile, offsets, tiles_x, width, height)
        left, top, rows, columns = place
        state, gates, records, todo, lit = room
        for r in range(rows):
            for k in range(columns):
                block, lane = find_lane(r, k)
                for c in range(3):
                    state[block, 1 + c, lane] = v_image[top + r, left + k, c]
        done = 0
        while done < total and lit[0] != 0:
            count = min(BATCH, total - done)
            prepare_shapes(splats, members, first, done, count, left, top, gates, records, todo)
            list_by_block(todo, count, by_block)
            call_up(out, pair_of, first + done, count)
            _gather_some(state, records, by_block, lit, sums)
            for j in range(count):
                take_sums(sums, j, out, np.int64(pair_of[first + done + j]))
            done += count
        for k in range(first + done, first + total):
            for e in range(4):
                out[pair_of[k], e] = 0.0
        tile = take_next(taken)


@in_parts(lambda order, *_: len(order))
@kernel(error_model="numpy")
def sum_shares(begin, end, order, first_pair, pairs, out):
    """Sum the pairs (P, 4) of each splat, in the order of its tiles: out (M, 3) float32."""
    for k in range(begin, end):
        m = order[k]
        for c in range(3):
            total = 0.0
            for p in range(first_pair[k], first_pair[k + 1]):
                total += pairs[p, c]
            out[m, c] = total
