"""Multiply rows by all atoms, and find the best atom, with explicit vectors.

A product runs tile by tile, ROWS x WIDTH numbers that stay in registers. Each is a sum over directions in their order,
independent of the other rows. Atoms come in panels, (P, D, WIDTH): WIDTH atoms along each direction.
"""

from __future__ import annotations

import math
from typing import Any

import llvmlite.binding as llvm
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from gsvis._kernels.compiled import inner, kernel
from gsvis._kernels.simd import Builder, Vector

__all__ = ["BLOCK", "WIDTH", "best_atom", "multiply", "multiply_rows"]

_WIDE = bool(llvm.get_host_cpu_features().get("avx512f"))
LANES, ROWS, VECTORS = (16, 8, 3) if _WIDE else (8, 6, 2)
"""A tile is ROWS x VECTORS vectors of LANES: as many as fit in registers."""

WIDTH = LANES * VECTORS
"""Number of atoms in a panel."""

BLOCK = 4 * ROWS
"""Number of signals that gain a term together."""

_I64 = ir.IntType(64)


@intrinsic
def _multiply_tile(typing_context, rows, first, panels, panel, out):
    """Compute out[first + s, panel * WIDTH + a] = rows[first + s] . panels[panel, :, a] for a tile ROWS x WIDTH."""
    del typing_context
    signature = types.void(rows, types.int64, panels, types.int64, out)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Emit the code."""
        lanes = Builder(builder, LANES, "float32")
        left, right, result = (context.make_array(sig.args[k])(context, builder, args[k]) for k in (0, 2, 4))
        depth = cgutils.unpack_tuple(builder, left.shape, 2)[1]
        columns = cgutils.unpack_tuple(builder, result.shape, 2)[1]
        width = ir.Constant(_I64, WIDTH)
        numbers = [builder.add(args[1], ir.Constant(_I64, s)) for s in range(ROWS)]
        starts = [builder.gep(left.data, [builder.mul(number, depth)]) for number in numbers]
        panel = builder.gep(right.data, [builder.mul(builder.mul(args[3], depth), width)])
        rooms = [
            [cgutils.alloca_once_value(builder, lanes.constant(0.0).value) for _ in range(VECTORS)] for _ in range(ROWS)
        ]
        offsets = [ir.Constant(_I64, v * LANES) for v in range(VECTORS)]
        with cgutils.for_range(builder, depth) as loop:
            at = builder.gep(panel, [builder.mul(loop.index, width)])
            vectors = [lanes.load(at, offset) for offset in offsets]
            for start, room in zip(starts, rooms, strict=True):
                value = lanes.splat(builder.load(builder.gep(start, [loop.index])))
                for v in range(VECTORS):
                    total = vectors[v].times_plus(value, Vector(lanes, builder.load(room[v])))
                    builder.store(total.value, room[v])
        for number, room in zip(numbers, rooms, strict=True):
            place = builder.add(builder.mul(number, columns), builder.mul(args[3], width))
            for v in range(VECTORS):
                lanes.store(Vector(lanes, builder.load(room[v])), result.data, builder.add(place, offsets[v]))
        return context.get_dummy_value()

    return signature, generate


@intrinsic
def best_atom(typing_context, correlations, channels, gains, signal):
    """Return the largest sum over channels of a signal's correlations^2 * gains, and its first index.

    Args:
        typing_context: numba's, unused.
        correlations: (C * B, P * WIDTH) float32, a block of signals for each channel.
        channels: C.
        gains: (B, P * WIDTH) float32, not negative.
        signal: Index of the signal in the block.

    Returns:
        float32 and int64; 0.0 and 0 if nothing is above 0.
    """
    del typing_context
    pair = types.Tuple((types.float32, types.int64))
    signature = pair(correlations, types.int64, gains, types.int64)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Emit the code."""
        lanes = Builder(builder, LANES, "float32")
        values, factors = (context.make_array(sig.args[k])(context, builder, args[k]) for k in (0, 2))
        signals, columns = cgutils.unpack_tuple(builder, factors.shape, 2)
        start = builder.gep(values.data, [builder.mul(args[3], columns)])
        gain = builder.gep(factors.data, [builder.mul(args[3], columns)])
        stride = builder.mul(signals, columns)
        zero = lanes.constant(0.0).value
        best, found, score = (cgutils.alloca_once_value(builder, zero) for _ in range(3))
        place = cgutils.alloca_once_value(builder, lanes.counting().value)
        step = ir.Constant(_I64, LANES)
        with cgutils.for_range(builder, builder.sdiv(columns, step)) as loop:
            offset = builder.mul(loop.index, step)
            builder.store(zero, score)
            with cgutils.for_range(builder, args[1]) as channel:
                value = lanes.load(start, builder.add(offset, builder.mul(channel.index, stride)))
                builder.store(value.times_plus(value, Vector(lanes, builder.load(score))).value, score)
            now = Vector(lanes, builder.load(score)) * lanes.load(gain, offset)
            before = Vector(lanes, builder.load(best))
            here = Vector(lanes, builder.load(place))
            better = now.compare(">", before)
            builder.store(better.where(now, before).value, best)
            builder.store(better.where(here, Vector(lanes, builder.load(found))).value, found)
            builder.store((here + float(LANES)).value, place)
        most = Vector(lanes, builder.load(best)).largest()
        same = Vector(lanes, builder.load(best)).compare("==", lanes.splat(most))
        backward = same.where(Vector(lanes, builder.load(found)) * -1.0, -math.inf)
        index = builder.fptosi(builder.fneg(backward.largest()), _I64)
        return context.make_tuple(builder, pair, [most, index])

    return signature, generate


@inner
def multiply_rows(rows, count, panels, out):
    """Multiply the first `count` rows (B, D), rounded up to whole tiles, by the panels, into out (B, P * WIDTH)."""
    for panel in range(len(panels)):
        for first in range(0, count, ROWS):
            _multiply_tile(rows, first, panels, panel, out)


@kernel
def multiply(rows, panels, out):
    """Multiply rows (N, D), N a multiple of BLOCK, by the panels (P, D, WIDTH), into out (N, P * WIDTH)."""
    for first in range(0, len(rows), BLOCK):
        multiply_rows(rows[first : first + BLOCK], BLOCK, panels, out[first : first + BLOCK])
