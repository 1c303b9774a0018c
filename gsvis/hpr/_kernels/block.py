"""Blend one Gaussian into a block of 16 x 16 pixels, as explicit vectors: light, depths, largest weight.

A row of a block is one vector. log2 alpha is `p(x, y) = c + lx x + ly y + A x^2 + B x y + C y^2` over its pixels
x, y = 0..15, which float32 knows well where a pixel sees the Gaussian, however far its center lies. Rows that the
Gaussian does not reach, or without light, are found for all sixteen at once.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from gsvis._kernels.simd import Builder, Vector

__all__ = ["LANES", "STRIDE", "blend_block", "take_largest"]

LANES = 16
STRIDE = 64 + LANES
"""Pixels from a row of a square to the next: the square's width, and room for a block that extends beyond it."""

_LOG2_255 = 7.994353436858858
_I64 = ir.IntType(64)


def _int(number: int) -> Any:
    return ir.Constant(_I64, number)


def _rows_with_light(builder: Any, lit: Any, x: Any, y: Any) -> Any:
    """Return an int64, bit k set if row y + k has light in one of the 16 pixels from x on."""
    rows = ir.VectorType(_I64, LANES)
    words = builder.load(builder.bitcast(builder.gep(lit, [y]), rows.as_pointer()), align=8)
    mask = builder.shl(_int(2**LANES - 1), x)
    nothing = ir.Constant(rows, ir.Undefined)
    order = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
    masks = builder.shuffle_vector(builder.insert_element(nothing, mask, _int(0)), nothing, order)
    found = builder.icmp_unsigned("!=", builder.and_(words, masks), ir.Constant(rows, [0] * LANES))
    return builder.zext(builder.bitcast(found, ir.IntType(LANES)), _I64)


def _reached_rows(lanes: Builder, form: list[Any]) -> Any:
    """Return an int64, bit k set if alpha reaches 1/255 somewhere along row k."""
    c, lx, ly, a, b, square = (lanes.splat(entry) for entry in form)
    y = lanes.counting()
    slope = y.times_plus(b, lx)
    level = y.times_plus(square, ly).times_plus(y, c)
    # A < 0: the dilation keeps every conic positive
    peak = (slope * (lanes.constant(-0.5) / a)).most(0.0).least(LANES - 1.0)
    return a.times_plus(peak, slope).times_plus(peak, level).compare(">=", -_LOG2_255).bits()


@intrinsic
def blend_block(typing_context, square, lit, form, spent, cover, far, x, y, rows, most):
    """Blend a Gaussian into a block of a square of pixels.

    Args:
        typing_context: The typing context of numba, unused.
        square: (2, 64, STRIDE) float32, changed in place: transmittance, and the distance at which it is spent.
        lit: (64 + 16,) uint64, changed in place: for each row, bit x set if pixel x has light left.
        form: Six float32: c, lx, ly, A, B, C of log2 alpha from the block's first pixel.
        spent: Transmittance below which a pixel is spent.
        cover: Share of the weight that is taken from the light.
        far: Distance of the Gaussian.
        x: First column of the block in the square.
        y: First row of the block in the square.
        rows: Number of rows of the block, 1 to 16.
        most: (32,) float32, changed in place: largest weight and largest light, lane by lane. Spent pixels are
            skipped.

    Returns:
        int64, number of pixels that became spent.
    """
    del typing_context
    f32 = types.float32
    i64 = types.int64
    signature = i64(square, lit, types.UniTuple(f32, 6), f32, f32, f32, i64, i64, i64, most)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Emit the code."""
        lanes = Builder(builder, LANES, "float32")
        data, words, largest = (context.make_array(sig.args[k])(context, builder, args[k]).data for k in (0, 1, 9))
        form = cgutils.unpack_tuple(builder, args[2], 6)
        c, lx, ly, a, b, quadratic = (lanes.splat(entry) for entry in form)
        limit = lanes.splat(args[3])
        cover = lanes.splat(args[4])
        far = lanes.splat(args[5])
        column = args[6]
        first = args[7]
        k = lanes.counting()
        along = a.times_plus(k, lx).times_plus(k, c)
        across = b.times_plus(k, ly)
        room = [cgutils.alloca_once_value(builder, lanes.load(largest, _int(n)).value) for n in (0, LANES)]
        darkened = cgutils.alloca_once_value(builder, _int(0))
        below = builder.sub(builder.shl(_int(1), args[8]), _int(1))
        todo = builder.and_(
            _reached_rows(lanes, form), builder.and_(_rows_with_light(builder, words, column, first), below)
        )
        before_loop = builder.block
        head, inside, done = (builder.append_basic_block(name) for name in ("rows", "row", "done"))
        builder.branch(head)
        builder.position_at_end(head)
        left = builder.phi(_I64)
        left.add_incoming(todo, before_loop)
        builder.cbranch(builder.icmp_unsigned("!=", left, _int(0)), inside, done)
        builder.position_at_end(inside)
        number = builder.cttz(left, ir.Constant(ir.IntType(1), 1))
        row = builder.add(first, number)
        offset = builder.add(builder.mul(row, _int(STRIDE)), column)
        y = lanes.splat(builder.sitofp(number, ir.FloatType()))
        p = quadratic.times_plus(y, across).times_plus(y, along)
        before = lanes.load(data, offset)
        seen = p.compare(">=", -_LOG2_255) & before.compare(">=", limit)
        weight = seen.where(p.exp2().least(0.999), 0.0) * before
        after = before - weight * cover
        lanes.store(after, data, offset)
        for place, vector in zip(room, (weight, seen.where(before, 0.0)), strict=True):
            builder.store(Vector(lanes, builder.load(place)).most(vector).value, place)
        crossed = seen & after.compare("<", limit)
        with builder.if_then(crossed.any(), likely=False):
            depth = builder.add(offset, _int(64 * STRIDE))
            lanes.store(crossed.where(far, lanes.load(data, depth)), data, depth)
            bits = crossed.bits()
            word = builder.gep(words, [row])
            builder.store(builder.and_(builder.load(word), builder.not_(builder.shl(bits, column))), word)
            builder.store(builder.add(builder.load(darkened), builder.ctpop(bits)), darkened)
        left.add_incoming(builder.and_(left, builder.sub(left, _int(1))), builder.block)
        builder.branch(head)
        builder.position_at_end(done)
        for place, n in zip(room, (0, LANES), strict=True):
            lanes.store(Vector(lanes, builder.load(place)), largest, _int(n))
        return builder.load(darkened)

    return signature, generate


@intrinsic
def take_largest(typing_context, most, which):
    """Return the largest of lanes 16 * which .. 16 * which + 15, and set them to 0."""
    del typing_context
    signature = types.float32(most, types.int64)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Emit the code."""
        lanes = Builder(builder, LANES, "float32")
        found = context.make_array(sig.args[0])(context, builder, args[0]).data
        place = builder.mul(args[1], _int(LANES))
        largest = lanes.load(found, place).largest()
        lanes.store(lanes.constant(0.0), found, place)
        return largest

    return signature, generate
