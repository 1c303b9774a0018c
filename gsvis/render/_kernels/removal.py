"""Kernels that remove each Gaussian from a tile, one at a time, and sum the changes of the tile's pixels.

A pixel's color is linear in the alpha of any one Gaussian: without it, the light it took falls on what lies behind.
With B the color that full light would show behind it, c its own and w its weight, the pixel changes by w (B - c).
Gaussians may be present in part, with a share of their alpha. Sums are per (tile, splat) pair and do not depend on the
number of threads.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import types
from numba.extending import intrinsic

from gsvis._kernels.compiled import inner, kernel, uncounted
from gsvis._kernels.shared import take_next
from gsvis._kernels.simd import Vector
from gsvis._kernels.threads import in_threads
from gsvis.render._kernels.forward import Block, Held, freeze, list_by_block, place_of, take_sums
from gsvis.render._kernels.lanes import (
    BATCH,
    BLOCKS,
    LANES,
    PLACE,
    RECORD,
    STOP,
    Record,
    T,
)
from gsvis.render._kernels.tiles import allocate, call_up, find_lane, open_tile, prepare

__all__ = ["add_pairs", "remove_tiles", "sum_squares"]

SPENT = 1e-6
"""Transmittance at which light counts as spent; lower than an image's, as a removal can let 1000 times more through."""

PRESENT = 9
"""Entry of a record, in the place of a depth: the share of its alpha with which the Gaussian is there, in [0, 1]."""

BEHIND = (1, 2, 3)
RESIDUAL = (4, 5, 7)
"""Channels of the state on the way back: the color behind, and image minus target. T and STOP are the lanes'."""


@intrinsic
def _dim(typing_context, state, block, records, members, lit):
    """Let Gaussians take their light from one block of a tile, according to their presence, going front to back.

    A pixel whose light falls to SPENT keeps it negated, and in STOP the place behind the Gaussian that took it.

    Args:
        typing_context: numba's, unused.
        state: (BLOCKS, CHANNELS, LANES) float32.
        block: Number of the block.
        records: (BATCH + 1, RECORD) float32; the last reaches nothing.
        members: int64, the records to take, as bits.
        lit: (1,) int64, blocks with light left; the bit is cleared if it is spent.
    """
    del typing_context
    signature = types.void(state, types.int64, records, types.int64, lit)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Emit the code."""
        lit_blocks = context.make_array(sig.args[4])(context, builder, args[4]).data
        part = Block(context, builder, sig, args)
        given = [part.load(channel) for channel in (T, STOP)]
        given.append(given[0].most(0.0))

        def body(number: Any, record: Record, alpha: Vector, held: Held) -> Held:
            """Return what is left, where it ended, and the falling light behind a Gaussian."""
            del number
            left, stop, light = held
            after = light - record[PRESENT] * alpha * light
            is_lit = light.compare(">", SPENT)
            return [is_lit.where(after, left), is_lit.where(record[PLACE], stop), after]

        left, stop, light = part.pass_members(given, body)
        part.store(stop, STOP)
        part.end(freeze(light, left, SPENT), lit_blocks)
        return context.get_dummy_value()

    return signature, generate


@intrinsic
def _remove(typing_context, state, block, records, members, sums):
    """Pass the Gaussians of one block of a tile, going back to front; sum how absence and presence change its pixels.

    The state holds the transmittance behind the Gaussian in T, the color behind it under full light in BEHIND, and the
    image minus the target in RESIDUAL.

    Args:
        typing_context: numba's, unused.
        state: (BLOCKS, CHANNELS, LANES) float32; pixels whose STOP a Gaussian's PLACE exceeds never blended it.
        block: Number of the block.
        records: (BATCH + 1, RECORD) float32; the last reaches nothing.
        members: int64, the records to pass, as bits.
        sums: (BATCH + 1, 3, LANES) float32, to which for each record the sums over pixels and channels of |d|, d^2 and
            d (2 r + (2 p - 1) d) are added, where d is a value without the Gaussian minus the value with all of it, r
            its residual with the share p of it.
    """
    del typing_context
    signature = types.void(state, types.int64, records, types.int64, sums)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Emit the code."""
        out = context.make_array(sig.args[4])(context, builder, args[4]).data
        part = Block(context, builder, sig, args)
        lanes = part.lanes
        stop = part.load(STOP)
        residuals = [part.load(channel) for channel in RESIDUAL]

        def body(number: Any, record: Record, alpha: Vector, held: Held) -> Held:
            """Return the light and the color in front of a Gaussian, and add its sums."""
            t, *colors = held
            present = record[PRESENT]
            excess = present.times_plus(2.0, -1.0)
            alpha = stop.compare(">=", record[PLACE]).where(alpha, 0.0)
            share = present * alpha
            front = t / (lanes.constant(1.0) - share)
            weight = alpha * front
            places = [place_of(builder, number, 3, k) for k in range(3)]
            totals = [lanes.load(out, place) for place in places]
            in_front = []
            for channel, behind in enumerate(colors):
                further = behind - record[6 + channel]
                change = weight * further
                totals[0] = totals[0] + change.most(change * -1.0)
                totals[1] = change.times_plus(change, totals[1])
                totals[2] = change.times_plus(residuals[channel].times_plus(2.0, excess * change), totals[2])
                in_front.append((share * -1.0).times_plus(further, behind))
            for place, total in zip(places, totals, strict=True):
                lanes.store(total, out, place)
            return [front, *in_front]

        channels = (T, *BEHIND)
        held = part.pass_members([part.load(channel) for channel in channels], body, backward=True)
        for channel, vector in zip(channels, held, strict=True):
            part.store(vector, channel)
        return context.get_dummy_value()

    return signature, generate


@uncounted
def _dim_some(state, records, by_block, lit):
    """Let prepared Gaussians take their light from the blocks that they reach; those without light lose them."""
    for block in range(BLOCKS):
        if (lit[0] >> block) & 1 == 0:
            by_block[block] = 0
        elif by_block[block]:
            _dim(state, block, records, by_block[block], lit)


@uncounted
def _remove_some(state, records, by_block, sums):
    """Pass prepared Gaussians in the blocks that they reach."""
    for block in range(BLOCKS):
        if by_block[block]:
            _remove(state, block, records, by_block[block], sums)


@uncounted
def _turn(state, residual, background, left, top, rows, columns):
    """Prepare the state at the back of a tile for the pass to the front."""
    for r in range(rows):
        for k in range(columns):
            block, lane = find_lane(r, k)
            state[block, 0, lane] = abs(state[block, 0, lane])
            for c in range(3):
                state[block, BEHIND[c], lane] = background[c]
                state[block, RESIDUAL[c], lane] = residual[top + r, left + k, c]


@inner
def _make_room(batches):
    """Return room for records (batches, BATCH + 1, RECORD), of which the last of a batch reaches nothing, and lists."""
    records = allocate(np.int64(batches * (BATCH + 1) * RECORD)).reshape((batches, BATCH + 1, RECORD))
    records[:, BATCH, 0] = -1e9
    return records, np.empty((batches, BLOCKS), np.int64)


@in_threads(lambda splats, features, offsets, *_: len(offsets) - 1)
@kernel(error_model="numpy")
def remove_tiles(taken, splats, features, offsets, members, pair_of, tiles_x, background, residual, out):
    """Write the sums of every (tile, splat) pair into out (P, 4) float32; see `_remove`.

    `features` is (M, 4) float32: color, and the share of its alpha with which the splat is there. `residual` is
    (H, W, 3) float32.
    """
    height, width = residual.shape[:2]
    tiles = len(offsets) - 1
    kept, by_block = _make_room(32)
    sums = allocate(np.int64((BATCH + 1) * 3 * LANES)).reshape((BATCH + 1, 3, LANES))
    tile = take_next(taken)
    while tile < tiles:
        place, (first, total), room = open_tile(tile, offsets, tiles_x, width, height)
        left, top, rows, columns = place
        state, gates, _, todo, lit = room
        batches = (total + BATCH - 1) // BATCH
        if batches > len(kept):
            kept, by_block = _make_room(2 * batches)
        done = 0
        while done < batches and lit[0] != 0:
            start = done * BATCH
            count = min(BATCH, total - start)
            prepare(splats, features, members, first, start, count, left, top, gates, kept[done], todo)
            list_by_block(todo, count, by_block[done])
            _dim_some(state, kept[done], by_block[done], lit)
            done += 1
        _turn(state, residual, background, left, top, rows, columns)
        for k in range(first + min(done * BATCH, total), first + total):
            for e in range(4):
                out[pair_of[k], e] = 0.0
        for batch in range(done - 1, -1, -1):
            start = first + batch * BATCH
            count = min(BATCH, first + total - start)
            call_up(out, pair_of, start, count)
            _remove_some(state, kept[batch], by_block[batch], sums)
            for j in range(count):
                take_sums(sums, j, out, np.int64(pair_of[start + j]))
        tile = take_next(taken)


@kernel
def add_pairs(pairs, first_pair, order, ids, sums):
    """Add the first three entries of the pairs (P, 4) of each splat to the row of its Gaussian in sums (N, 3)."""
    for k in range(len(order)):
        absolute = 0.0
        squared = 0.0
        change = 0.0
        for pair in range(first_pair[k], first_pair[k + 1]):
            absolute += pairs[pair, 0]
            squared += pairs[pair, 1]
            change += pairs[pair, 2]
        row = ids[order[k]]
        sums[row, 0] += absolute
        sums[row, 1] += squared
        sums[row, 2] += change


@kernel
def sum_squares(pairs, first_pair, order, out):
    """Write a third of the sum of the squared changes of the pairs (P, 4) of each splat into out (M,).

    Pairs are summed over three channels; a third is their mean.
    """
    for k in range(len(order)):
        squared = 0.0
        for pair in range(first_pair[k], first_pair[k + 1]):
            squared += pairs[pair, 1]
        out[order[k]] = squared / 3.0
