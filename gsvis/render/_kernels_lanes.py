"""One Gaussian against the rows of one tile, as explicit vectors: blend, weigh, and blend backward.

A tile is 16 pixels wide, one vector. Its state is (16 rows, CHANNELS, 16) float32. The Gaussian comes as the polynomial
`p(x, y) = c + lx x + ly y + A x^2 + B x y + C y^2` = log2 alpha over the tile's pixels x, y = 0..15, which is exact in
float32 where a pixel sees the Gaussian, however far its centre lies. A pixel whose transmittance is spent holds it
negated. Knows no cameras and no lists.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from gsvis._simd import Builder, Vector

__all__ = ["CHANNELS", "LANES", "blend", "blend_backward", "weigh"]

LANES = 16
CHANNELS = 8
T, RED, GREEN, BLUE, DEPTH, MEDIAN, LAST, GATE = range(8)
"""Forward state. Backward reads T and LAST, and holds in RED..DEPTH the gradients, in MEDIAN what lies behind.

The first lane of GATE closes a row: a Gaussian whose place in the list is above it changes no pixel of the row.
"""

_LOG2_255 = 7.994353436858858
_LN2 = 0.6931471805599453
_F32 = ir.FloatType()
_I64 = ir.IntType(64)

_polynomial = types.UniTuple(types.float32, 6)
_feature = types.UniTuple(types.float32, 4)
_RowBody = Callable[[Any, Any, Vector, Vector, Vector], None]


def _emit_rows(builder: Any, state: Any, polynomial: Any, place: Any, rows: Any, body: _RowBody) -> None:
    """Loop over rows [start, stop) and call `body(offset, row, p, seen, t)` where a lit pixel sees the Gaussian.

    `offset(channel)` is the place of a channel of this row, `row` its number as float32, `p` log2 alpha, `seen` the
    mask of lit pixels with alpha >= 1/255, `t` the transmittance.
    """
    lanes = Builder(builder, LANES, "float32")
    c, lx, ly, a, b, q = (builder.extract_value(polynomial, k) for k in range(6))
    zero, threshold = ir.Constant(_F32, 0.0), ir.Constant(_F32, -_LOG2_255)
    widest, minus_half = ir.Constant(_F32, LANES - 1.0), ir.Constant(_F32, -0.5)
    peak_factor = builder.fdiv(minus_half, a)  # a < 0: the dilation keeps every conic positive
    x, spread = lanes.counting(), lanes.splat(a)
    start, stop = rows
    with cgutils.for_range_slice(builder, start, stop, ir.Constant(_I64, 1), intp=_I64) as (row, _):
        y = builder.sitofp(row, _F32)
        slope = builder.fadd(lx, builder.fmul(b, y))
        level = builder.fadd(c, builder.fmul(builder.fadd(ly, builder.fmul(q, y)), y))
        peak = builder.fmul(slope, peak_factor)
        peak = builder.select(builder.fcmp_ordered(">", peak, zero), peak, zero)
        peak = builder.select(builder.fcmp_ordered("<", peak, widest), peak, widest)
        most = builder.fadd(builder.fmul(builder.fadd(builder.fmul(a, peak), slope), peak), level)
        first = builder.mul(row, ir.Constant(_I64, CHANNELS * LANES))

        def offset(channel: int, first: Any = first) -> Any:
            return builder.add(first, ir.Constant(_I64, channel * LANES))

        gate = builder.load(builder.gep(state, [offset(GATE)]))
        reached = builder.fcmp_ordered(">=", most, threshold)
        with builder.if_then(builder.and_(reached, builder.fcmp_ordered(">=", gate, place))):
            p = spread.times_plus(x, lanes.splat(slope)).times_plus(x, lanes.splat(level))
            t = lanes.load(state, offset(T))
            seen = p.compare(">=", -_LOG2_255) & t.compare(">", 0.0)
            with builder.if_then(seen.any()):
                body(offset, y, p, seen, t)


def _alpha_and_next(p: Vector, seen: Vector, t: Vector) -> tuple[Vector, Vector, Vector]:
    """Alpha where blended (else 0), the new transmittance (negated where spent), and the mask of blended lanes."""
    alpha = p.exp2().least(0.999)
    after = t - t * alpha
    blended = seen & after.compare(">", 1e-4)
    spent = seen & after.compare("<=", 1e-4)
    return blended.where(alpha, 0.0), blended.where(after, spent.where(t * -1.0, t)), blended


def _store_light(lanes: Builder, after: Vector, state: Any, offset: Callable[[int], Any]) -> None:
    """Keep the transmittance, and close the row when no pixel of it is lit."""
    lanes.store(after, state, offset(T))
    lit = after.compare(">", 0.0).any()
    gate = lanes.ir.select(lit, ir.Constant(_F32, float("inf")), ir.Constant(_F32, -1.0))
    lanes.ir.store(gate, lanes.ir.gep(state, [offset(GATE)]))


@intrinsic
def blend(typing_context, state, polynomial, feature, index, start, stop):
    """Blend one Gaussian into rows [start, stop) of a tile, front to back.

    Args:
        typing_context: numba's, unused.
        state: (16, CHANNELS, 16) float32.
        polynomial: Six float32: c, lx, ly, A, B, C.
        feature: Four float32: red, green, blue, depth.
        index: float32, place of the Gaussian in the tile's list, kept in LAST.
        start: First row.
        stop: One past the last row.
    """
    del typing_context
    signature = types.void(state, _polynomial, _feature, types.float32, types.int64, types.int64)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        lanes = Builder(builder, LANES, "float32")
        features = [lanes.splat(builder.extract_value(args[2], k)) for k in range(4)]
        place = lanes.splat(args[3])

        def body(offset: Any, row: Any, p: Vector, seen: Vector, t: Vector) -> None:
            alpha, after, blended = _alpha_and_next(p, seen, t)
            weight = alpha * t
            for channel, value in zip((RED, GREEN, BLUE, DEPTH), features, strict=True):
                lanes.store(weight.times_plus(value, lanes.load(data, offset(channel))), data, offset(channel))
            halved = blended & t.compare(">", 0.5) & after.compare("<=", 0.5)
            lanes.store(halved.where(features[3], lanes.load(data, offset(MEDIAN))), data, offset(MEDIAN))
            lanes.store(blended.where(place, lanes.load(data, offset(LAST))), data, offset(LAST))
            _store_light(lanes, after, data, offset)

        _emit_rows(builder, data, args[1], args[3], (args[4], args[5]), body)
        return context.get_dummy_value()

    return signature, generate


@intrinsic
def weigh(typing_context, state, polynomial, start, stop):
    """Like `blend` without colours: returns the largest and the summed weight over the rows.

    Args:
        typing_context: numba's, unused.
        state: (16, CHANNELS, 16) float32, of which only T and GATE are used.
        polynomial: Six float32: c, lx, ly, A, B, C.
        start: First row.
        stop: One past the last row.

    Returns:
        Tuple of two float32.
    """
    del typing_context
    pair = types.UniTuple(types.float32, 2)
    signature = pair(state, _polynomial, types.int64, types.int64)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        lanes = Builder(builder, LANES, "float32")
        sums = [cgutils.alloca_once_value(builder, lanes.constant(0.0).value) for _ in range(2)]

        def body(offset: Any, row: Any, p: Vector, seen: Vector, t: Vector) -> None:
            alpha, after, _ = _alpha_and_next(p, seen, t)
            weight = alpha * t
            builder.store(Vector(lanes, builder.load(sums[0])).most(weight).value, sums[0])
            builder.store((Vector(lanes, builder.load(sums[1])) + weight).value, sums[1])
            _store_light(lanes, after, data, offset)

        _emit_rows(builder, data, args[1], ir.Constant(_F32, 0.0), (args[2], args[3]), body)
        largest = Vector(lanes, builder.load(sums[0])).largest()
        return context.make_tuple(builder, pair, [largest, Vector(lanes, builder.load(sums[1])).sum()])

    return signature, generate


@intrinsic
def blend_backward(typing_context, state, polynomial, feature, centre, index, start, stop):
    """Take one Gaussian out of rows [start, stop) of a tile, back to front, and sum its gradients.

    The state holds the transmittance behind the Gaussian in T, the gradient of the loss by each channel in
    RED..DEPTH, and in MEDIAN the gradient-weighted light from behind, S.

    Args:
        typing_context: numba's, unused.
        state: (16, CHANNELS, 16) float32.
        polynomial: Six float32: c, lx, ly, A, B, C.
        feature: Four float32: red, green, blue, depth.
        centre: Two float32, the Gaussian's centre from the tile's first pixel.
        index: float32, place of the Gaussian in the tile's list; pixels with a smaller LAST never blended it.
        start: First row.
        stop: One past the last row.

    Returns:
        Ten float32: gradients by red, green, blue, depth; then with q = dL/dalpha * alpha (0 where alpha is capped)
        and d = centre - pixel: sums of q, q dx, q dy, q dx^2, q dx dy, q dy^2.

    References:
        Chain rule through front-to-back blending: dL/dalpha_i = T_i c_i.v - S_i / (1 - alpha_i).
    """
    del typing_context
    ten = types.UniTuple(types.float32, 10)
    two = types.UniTuple(types.float32, 2)
    signature = ten(state, _polynomial, _feature, two, types.float32, types.int64, types.int64)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        lanes = Builder(builder, LANES, "float32")
        features = [lanes.splat(builder.extract_value(args[2], k)) for k in range(4)]
        dx = lanes.splat(builder.extract_value(args[3], 0)) - lanes.counting()
        centre_y = builder.extract_value(args[3], 1)
        place = lanes.splat(args[4])
        sums = [cgutils.alloca_once_value(builder, lanes.constant(0.0).value) for _ in range(10)]

        def add(k: int, value: Vector, factor: Vector) -> None:
            builder.store(value.times_plus(factor, Vector(lanes, builder.load(sums[k]))).value, sums[k])

        def body(offset: Any, row: Any, p: Vector, seen: Vector, t: Vector) -> None:
            response = p.exp2()
            alpha = response.least(0.999)
            live = seen & place.compare("<=", lanes.load(data, offset(LAST)))
            alpha = live.where(alpha, 0.0)
            opening = lanes.constant(1.0) / (lanes.constant(1.0) - alpha)
            front = t * opening
            gradients = [lanes.load(data, offset(channel)) for channel in (RED, GREEN, BLUE, DEPTH)]
            shine = features[0] * gradients[0]
            for value, gradient in zip(features[1:], gradients[1:], strict=True):
                shine = value.times_plus(gradient, shine)
            weight = alpha * front
            behind = lanes.load(data, offset(MEDIAN))
            by_alpha = front * shine - opening * behind
            for k, gradient in enumerate(gradients):
                add(k, weight, gradient)
            free = live & response.compare("<", 0.999)
            q = free.where(by_alpha * response, 0.0)
            dy = lanes.splat(builder.fsub(centre_y, row))
            qx, qy, one = q * dx, q * dy, lanes.constant(1.0)
            for k, value, factor in ((4, q, one), (5, qx, one), (6, qy, one), (7, qx, dx), (8, qx, dy), (9, qy, dy)):
                add(k, value, factor)
            lanes.store(weight.times_plus(shine, behind), data, offset(MEDIAN))
            lanes.store(front, data, offset(T))

        _emit_rows(builder, data, args[1], args[4], (args[5], args[6]), body)
        return context.make_tuple(builder, ten, [Vector(lanes, builder.load(s)).sum() for s in sums])

    return signature, generate
