"""Compute lobes along many directions and their inner products, with explicit vectors of 16 directions.

Rows are float32 over directions, padded to whole vectors. `points` holds x, y, z and the square root of the weight.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from gsvis._kernels.compiled import kernel
from gsvis._kernels.simd import Builder, Vector

__all__ = ["LANES", "append_products", "dots", "gram", "lobes"]

LANES = 16
_LOG2E = 1.4426950408889634
_I64 = ir.IntType(64)


@intrinsic
def _lobe(typing_context, points, place, v, decay, rows, row, slopes):
    """Compute sixteen values of one weighted lobe and of its three slopes.

    Args:
        typing_context: The typing context of numba, unused.
        points: (4, D) float32.
        place: First direction.
        v: Three float32, decay times center.
        decay: float32.
        rows: (P, D) float32, written.
        row: Row of the values.
        slopes: First of the three rows of the slopes by v.
    """
    del typing_context
    f32 = types.float32
    i64 = types.int64
    signature = types.void(points, i64, types.UniTuple(f32, 3), f32, rows, i64, i64)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Emit the code."""
        lanes = Builder(builder, LANES, "float32")
        source = context.make_array(sig.args[0])(context, builder, args[0])
        target = context.make_array(sig.args[4])(context, builder, args[4])
        length = builder.extract_value(source.shape, 1)

        def at(row: Any, more: int = 0) -> Any:
            first = builder.mul(builder.add(row, ir.Constant(_I64, more)), length)
            return builder.add(first, args[1])

        zero = ir.Constant(_I64, 0)
        position = [lanes.load(source.data, at(zero, k)) for k in range(3)]
        root = lanes.load(source.data, at(zero, 3))
        v = [lanes.splat(builder.extract_value(args[2], k)) for k in range(3)]
        decay = lanes.splat(args[3])
        exponent = position[0].times_plus(v[0], position[1].times_plus(v[1], position[2] * v[2])) - decay
        value = (exponent * _LOG2E).exp2() * root
        lanes.store(value, target.data, at(args[5]))
        for k in range(3):
            lanes.store(value * (position[k] - v[k] / decay), target.data, at(args[6], k))
        return context.get_dummy_value()

    return signature, generate


@intrinsic
def _block(typing_context, left, i, right, j, count, out):
    """Write 4 x 4 inner products of rows i.. of left and j.. of right over `count` entries into out (16,).

    The last row stands in for rows beyond it.
    """
    del typing_context
    i64 = types.int64
    signature = types.void(left, i64, right, i64, i64, out)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Emit the code."""
        lanes = Builder(builder, LANES, "float32")
        sides = []
        for array, row in ((0, 1), (2, 3)):
            view = context.make_array(sig.args[array])(context, builder, args[array])
            length = builder.extract_value(view.shape, 1)
            last = builder.sub(builder.extract_value(view.shape, 0), ir.Constant(_I64, 1))
            places = [builder.add(args[row], ir.Constant(_I64, k)) for k in range(4)]
            inside = [builder.select(builder.icmp_signed("<", at, last), at, last) for at in places]
            rows = [builder.mul(at, length) for at in inside]
            sides.append((view.data, rows))
        target = context.make_array(sig.args[5])(context, builder, args[5]).data
        before, loop, after = builder.block, *(builder.append_basic_block(name) for name in ("dots", "done"))
        builder.branch(loop)
        builder.position_at_end(loop)
        place = builder.phi(_I64)
        place.add_incoming(ir.Constant(_I64, 0), before)
        sums = [builder.phi(lanes.type) for _ in range(16)]
        for each in sums:
            each.add_incoming(lanes.constant(0.0).value, before)
        a, b = ([lanes.load(data, builder.add(row, place)) for row in rows] for data, rows in sides)
        following = builder.add(place, ir.Constant(_I64, LANES))
        for k, each in enumerate(sums):
            each.add_incoming(a[k // 4].times_plus(b[k % 4], Vector(lanes, each)).value, builder.block)
        place.add_incoming(following, builder.block)
        totals = [Vector(lanes, incoming[0]) for incoming in (each.incomings[1] for each in sums)]
        builder.cbranch(builder.icmp_signed("<", following, args[4]), loop, after)
        builder.position_at_end(after)
        lanes.store(lanes.sums(totals), target, ir.Constant(_I64, 0))
        return context.get_dummy_value()

    return signature, generate


@kernel
def lobes(points, count, v, terms, rows):
    """Write weighted lobes exp(v.x - |v|) into rows 0..terms-1, and their slopes by v_k from row terms + 3k on."""
    for k in range(terms):
        decay = np.sqrt(v[k, 0] * v[k, 0] + v[k, 1] * v[k, 1] + v[k, 2] * v[k, 2])
        vector = (np.float32(v[k, 0]), np.float32(v[k, 1]), np.float32(v[k, 2]))
        for place in range(0, count, LANES):
            _lobe(points, place, vector, np.float32(decay), rows, k, terms + 3 * k)


@kernel
def gram(rows, number, count, scratch, out):
    """Write inner products of the first `number` rows, a multiple of four, into out (number, number)."""
    for i in range(0, number, 4):
        for j in range(0, i + 4, 4):
            _block(rows, i, rows, j, count, scratch)
            for p in range(4):
                for q in range(4):
                    out[i + p, j + q] = scratch[4 * p + q]
                    out[j + q, i + p] = scratch[4 * p + q]


@kernel
def dots(rows, number, targets, channels, count, scratch, out):
    """Write inner products of the first `number` rows, a multiple of 4, with up to 4 targets, into out (number, .)."""
    for i in range(0, number, 4):
        _block(rows, i, targets, 0, count, scratch)
        for p in range(4):
            for c in range(channels):
                out[i + p, c] = scratch[4 * p + c]


@kernel
def append_products(fresh, rows, terms, targets, channels, count, scratch, inner, outer):
    """Add a lobe to `terms` lobes and their inner products: what `lobes`, `gram` and `dots` give for all of them.

    Args:
        fresh: (4, D) the new lobe and its three slopes, as `lobes` writes them.
        rows: (P, D) the lobes, then three slopes of each; changed in place.
        terms: Number of lobes before.
        targets: (4, D).
        channels: Number of targets.
        count: Number of directions, a multiple of 16.
        scratch: (16,) buffer.
        inner: (P, P) inner products of the rows; changed in place.
        outer: (P, C) those with the targets; changed in place.
    """
    for i in range(4 * terms - 1, -1, -1):  # slopes make room for the new lobe
        to = i if i < terms else i + 1
        for j in range(4 * terms - 1, -1, -1):
            inner[to, j if j < terms else j + 1] = inner[i, j]
        if i >= terms:
            for c in range(channels):
                outer[to, c] = outer[i, c]
            for d in range(count):
                rows[to, d] = rows[i, d]
    for p in range(4):
        to = terms if p == 0 else 4 * terms + p
        for d in range(count):
            rows[to, d] = fresh[p, d]
    for j in range(0, 4 * terms + 4, 4):
        _block(fresh, 0, rows, j, count, scratch)
        for p in range(4):
            to = terms if p == 0 else 4 * terms + p
            for q in range(4):
                inner[to, j + q] = scratch[4 * p + q]
                inner[j + q, to] = scratch[4 * p + q]
    _block(fresh, 0, targets, 0, count, scratch)
    for p in range(4):
        for c in range(channels):
            outer[terms if p == 0 else 4 * terms + p, c] = scratch[4 * p + c]
