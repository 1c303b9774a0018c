"""Kernels that remove each Gaussian from a tile, one at a time, and sum the changes of the tile's pixels.

A pixel's color is linear in the alpha of any one Gaussian: without it, the light it took falls on what lies behind.
With B the color that full light would show behind it, c its own and w its weight, the pixel changes by w (B - c).
Gaussians may be present in part, with a share of their alpha. Sums are per (tile, splat) pair and do not depend on the
number of threads.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from gsvis._kernels.compiled import kernel, uncounted
from gsvis._kernels.shared import take_next
from gsvis._kernels.simd import Builder, Vector
from gsvis._kernels.threads import in_threads
from gsvis.render._kernels.lanes import (
    LANES,
    STOP,
    Pixels,
    Record,
    T,
    darken,
    load_channel,
    store_channel,
    visit_blocks,
)
from gsvis.render._kernels.tiles import BATCH, find_lane, open_tile, prepare

__all__ = ["add_pairs", "remove_tiles", "sum_squares"]

SPENT = 1e-6
"""Transmittance at which light counts as spent; lower than an image's, as a removal can let 1000 times more through."""

PRESENT = 9
"""Entry of a record, in the place of a depth: the share of its alpha with which the Gaussian is there, in [0, 1]."""

BEHIND = (1, 2, 3)
RESIDUAL = (4, 5, 7)
"""Channels of the state on the way back: the color behind, and image minus target. T and STOP are the lanes'."""


@intrinsic
def _dim(typing_context, state, records, number, todo, lit, place):
    """Let one Gaussian take its light from a tile, according to its presence, going front to back.

    A pixel whose light falls to SPENT keeps it negated, and in STOP the place behind the Gaussian that took it.

    Args:
        typing_context: numba's, unused.
        state: (BLOCKS, CHANNELS, LANES) float32.
        records: (K, 16) float32.
        number: Index of the record.
        todo: int64, blocks that the Gaussian reaches.
        lit: (1,) int64, blocks with light left; bits are cleared as it is spent.
        place: float32, place of the Gaussian in the tile's list.
    """
    del typing_context
    signature = types.void(state, records, types.int64, types.int64, lit, types.float32)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Emit the code."""
        data, lit_blocks = (context.make_array(sig.args[k])(context, builder, args[k]).data for k in (0, 4))
        lanes = Builder(builder, LANES, "float32")
        record = Record(context, lanes, sig.args[1], args[1], args[2])

        def body(pixels: Pixels) -> None:
            """Emit the code for one block."""
            t = pixels.t
            after = pixels.seen.where(t - record[PRESENT] * pixels.p.exp2().least(0.999) * t, t)
            spent = pixels.seen & after.compare("<=", SPENT)
            after = spent.where(after * -1.0, after)
            behind = lanes.splat(args[5]) + 1.0
            store_channel(lanes, spent.where(behind, load_channel(lanes, pixels.state, STOP)), pixels.state, STOP)
            store_channel(lanes, after, pixels.state, T)
            darken(lanes, pixels.block, after, lit_blocks)

        visit_blocks(lanes, data, record, args[3], body)
        return context.get_dummy_value()

    return signature, generate


@intrinsic
def _remove(typing_context, state, records, number, todo, place, sums, pair):
    """Pass one Gaussian of a tile, going back to front, and sum how its absence and its presence change the pixels.

    The state holds the transmittance behind the Gaussian in T, the color behind it under full light in BEHIND, and the
    image minus the target in RESIDUAL.

    Args:
        typing_context: numba's, unused.
        state: (BLOCKS, CHANNELS, LANES) float32.
        records: (K, 16) float32.
        number: Index of the record.
        todo: int64, blocks that the Gaussian reaches.
        place: float32, place of the Gaussian in the tile's list; pixels whose STOP it reaches never blended it.
        sums: (P, 4) float32, receives in row `pair` the sums over pixels and channels of |d|, d^2 and
            d (2 r + (2 p - 1) d), where d is a value without the Gaussian minus the value with all of it, r its
            residual with the share p of it; and a zero.
        pair: Row of `sums`.
    """
    del typing_context
    signature = types.void(state, records, types.int64, types.int64, types.float32, sums, types.int64)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Emit the code."""
        data, out = (context.make_array(sig.args[k])(context, builder, args[k]).data for k in (0, 5))
        lanes = Builder(builder, LANES, "float32")
        record = Record(context, lanes, sig.args[1], args[1], args[2])
        color = [record[6 + k] for k in range(3)]
        place = lanes.splat(args[4])
        present = record[PRESENT]
        excess = present.times_plus(2.0, -1.0)
        rooms = [cgutils.alloca_once_value(builder, lanes.constant(0.0).value) for _ in range(3)]

        def body(pixels: Pixels) -> None:
            """Emit the code for one block."""
            state = pixels.state
            live = pixels.seen & place.compare("<", load_channel(lanes, state, STOP))
            alpha = live.where(pixels.p.exp2().least(0.999), 0.0)
            held = present * alpha
            front = pixels.t / (lanes.constant(1.0) - held)
            weight = alpha * front
            totals = [Vector(lanes, builder.load(room)) for room in rooms]
            for channel in range(3):
                behind = load_channel(lanes, state, BEHIND[channel])
                further = behind - color[channel]
                change = weight * further
                residual = load_channel(lanes, state, RESIDUAL[channel])
                totals[0] = totals[0] + change.most(change * -1.0)
                totals[1] = change.times_plus(change, totals[1])
                totals[2] = change.times_plus(residual.times_plus(2.0, excess * change), totals[2])
                store_channel(lanes, (held * -1.0).times_plus(further, behind), state, BEHIND[channel])
            for room, total in zip(rooms, totals, strict=True):
                builder.store(total.value, room)
            store_channel(lanes, front, state, T)

        visit_blocks(lanes, data, record, args[3], body)
        results = lanes.sums([Vector(lanes, builder.load(room)) for room in rooms])
        lanes.store_first(results, 4, out, builder.mul(args[6], ir.Constant(ir.IntType(64), 4)))
        return context.get_dummy_value()

    return signature, generate


@uncounted
def _dim_some(state, records, count, todo, lit, start):
    """Let `count` prepared Gaussians take their light, front to back; the first has the place `start`."""
    for j in range(count):
        _dim(state, records, j, todo[j] & lit[0], lit, np.float32(start + j))


@uncounted
def _remove_some(state, records, count, todo, start, out, pair_of, first):
    """Pass `count` prepared Gaussians, back to front; the list starts at `first`, and they at its place `start`."""
    for j in range(count - 1, -1, -1):
        _remove(state, records, j, todo[j], np.float32(start + j), out, np.int64(pair_of[first + start + j]))


@uncounted
def _turn(state, gates, residual, background, left, top, rows, columns):
    """Prepare the state at the back of a tile for the pass to the front."""
    gates[:] = -1.0
    for r in range(rows):
        for k in range(columns):
            block, lane = find_lane(r, k)
            state[block, 0, lane] = abs(state[block, 0, lane])
            for c in range(3):
                state[block, BEHIND[c], lane] = background[c]
                state[block, RESIDUAL[c], lane] = residual[top + r, left + k, c]
            gates[block] = max(gates[block], state[block, 6, lane])


@in_threads(lambda splats, features, offsets, *_: len(offsets) - 1)
@kernel(error_model="numpy")
def remove_tiles(taken, splats, features, offsets, members, pair_of, tiles_x, background, residual, out):
    """Write the sums of every (tile, splat) pair into out (P, 4) float32; see `_remove`.

    `features` is (M, 4) float32: color, and the share of its alpha with which the splat is there. `residual` is
    (H, W, 3) float32.
    """
    height, width = residual.shape[:2]
    tiles = len(offsets) - 1
    tile = take_next(taken)
    while tile < tiles:
        place, (first, total), room = open_tile(tile, offsets, tiles_x, width, height)
        left, top, rows, columns = place
        state, gates, records, todo, lit = room
        reached = 0
        for start in range(0, total, BATCH):
            if lit[0] == 0:
                break
            reached = min(start + BATCH, total)
            prepare(splats, features, members, first, start, reached - start, left, top, gates, records, todo)
            _dim_some(state, records, reached - start, todo, lit, start)
        _turn(state, gates, residual, background, left, top, rows, columns)
        for k in range(first + reached, first + total):
            for e in range(4):
                out[pair_of[k], e] = 0.0
        for start in range((reached - 1) // BATCH * BATCH, -1, -BATCH):
            count = min(BATCH, reached - start)
            prepare(splats, features, members, first, start, count, left, top, gates, records, todo)
            _remove_some(state, records, count, todo, start, out, pair_of, first)
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
