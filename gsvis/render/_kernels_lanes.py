"""One Gaussian against the rows of one tile, as explicit vectors: blend, weigh, and blend backward.

A tile is 16 pixels wide, one vector. Its state is (17, CHANNELS, 16) float32: 16 rows of channels, then the gates. The
Gaussian comes as the polynomial `p(x, y) = c + lx x + ly y + A x^2 + B x y + C y^2` = log2 alpha over the tile's pixels
x, y = 0..15, which float32 knows well where a pixel sees the Gaussian, however far its centre lies. A pixel whose
transmittance is spent holds it negated. Knows no cameras and no lists.
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
T, RED, GREEN, BLUE, DEPTH, MEDIAN, STOP = range(7)
"""Forward state. Backward reads T and STOP, and holds in RED..DEPTH the gradients, in MEDIAN what lies behind.

STOP is the place, in the tile's list, of the Gaussian that found the pixel's light spent, or inf. The gate of a row is
a place too: a Gaussian from there on changes no pixel of the row. Gates are the first 16 numbers behind the last row.
"""

_LOG2_255 = 7.994353436858858
_LN2 = 0.6931471805599453
_F32 = ir.FloatType()
_I64 = ir.IntType(64)

_polynomial = types.UniTuple(types.float32, 6)
_feature = types.UniTuple(types.float32, 4)
_RowBody = Callable[[Any, Any, Vector, Vector, Vector], None]
_GATES = LANES * CHANNELS * LANES


def _emit_rows(builder: Any, state: Any, polynomial: Any, place: Any, body: _RowBody) -> Any:
    """Call `body(offset, row, p, seen, t)` for each row in which a lit pixel may see the Gaussian.

    All rows are tested at once, by the peak of the polynomial along each. `offset(channel)` is the place of a channel
    of the row, `row` its number as int64, `p` log2 alpha, `seen` the mask of lit pixels with alpha >= 1/255, `t` the
    transmittance.

    Returns:
        int64, zero if every gate of the tile is closed.
    """
    lanes = Builder(builder, LANES, "float32")
    c, lx, ly, a, b, q = (builder.extract_value(polynomial, k) for k in range(6))
    rows = lanes.counting()
    slope = rows.times_plus(lanes.splat(b), lanes.splat(lx))
    level = rows.times_plus(lanes.splat(q), lanes.splat(ly)).times_plus(rows, lanes.splat(c))
    # a < 0: the dilation keeps every conic positive
    peak = (slope * lanes.splat(builder.fdiv(ir.Constant(_F32, -0.5), a))).most(0.0).least(LANES - 1.0)
    most = lanes.splat(a).times_plus(peak, slope).times_plus(peak, level)
    gates = lanes.load(state, ir.Constant(_I64, _GATES))
    todo = (most.compare(">=", -_LOG2_255) & gates.compare(">", lanes.splat(place))).bits()
    slopes, levels = (_spilled(lanes, vector) for vector in (slope, level))
    x, spread = lanes.counting(), lanes.splat(a)

    before = builder.block
    head, inside, after = (builder.append_basic_block(name) for name in ("rows", "row", "done"))
    builder.branch(head)
    builder.position_at_end(head)
    left = builder.phi(_I64)
    left.add_incoming(todo, before)
    builder.cbranch(builder.icmp_unsigned("!=", left, ir.Constant(_I64, 0)), inside, after)
    builder.position_at_end(inside)
    row = builder.cttz(left, ir.Constant(ir.IntType(1), 1))
    first = builder.mul(row, ir.Constant(_I64, CHANNELS * LANES))

    def offset(channel: int) -> Any:
        return builder.add(first, ir.Constant(_I64, channel * LANES))

    p = spread.times_plus(x, lanes.splat(_picked(builder, slopes, row)))
    p = p.times_plus(x, lanes.splat(_picked(builder, levels, row)))
    t = lanes.load(state, offset(T))
    seen = p.compare(">=", -_LOG2_255) & t.compare(">", 0.0)
    with builder.if_then(seen.any(), likely=True):
        body(offset, row, p, seen, t)
    left.add_incoming(builder.and_(left, builder.sub(left, ir.Constant(_I64, 1))), builder.block)
    builder.branch(head)
    builder.position_at_end(after)
    return gates.compare(">=", 0.0).bits()


def _spilled(lanes: Builder, vector: Vector) -> Any:
    """A vector on the stack, to pick lanes from."""
    return cgutils.alloca_once_value(lanes.ir, vector.value)


def _picked(builder: Any, spilled: Any, lane: Any) -> Any:
    """One lane of a spilled vector, as a scalar."""
    return builder.load(builder.gep(builder.bitcast(spilled, _F32.as_pointer()), [lane]))


def _pass_light(
    lanes: Builder,
    pixels: tuple[Vector, Vector, Vector],
    place: Any,
    state: Any,
    offset: Callable[[int], Any],
    row: Any,
) -> tuple[Vector, Vector]:
    """Let the Gaussian take its share of the light, and keep what is left. Returns the weight and the light left.

    `pixels` is (p, seen, t) as `_emit_rows` gives them.

    A pixel that would fall to 1e-4 blends nothing: its light is kept negated, the place of the Gaussian in STOP, and
    its row is closed if it was the last one lit. That happens once a pixel, so it stands behind a branch.
    """
    builder = lanes.ir
    p, seen, t = pixels
    alpha = seen.where(p.exp2().least(0.999), 0.0)
    share = alpha * t
    after = t - share
    weight_room = cgutils.alloca_once(builder, lanes.type)
    after_room = cgutils.alloca_once(builder, lanes.type)
    builder.store(share.value, weight_room)
    builder.store(after.value, after_room)
    spent = seen & after.compare("<=", 1e-4)
    with builder.if_then(spent.any(), likely=False):
        left = spent.where(t * -1.0, after)
        builder.store(spent.where(0.0, share).value, weight_room)
        builder.store(left.value, after_room)
        lanes.store(spent.where(lanes.splat(place), lanes.load(state, offset(STOP))), state, offset(STOP))
        gate = builder.select(left.compare(">", 0.0).any(), ir.Constant(_F32, float("inf")), ir.Constant(_F32, -1.0))
        builder.store(gate, builder.gep(state, [builder.add(row, ir.Constant(_I64, _GATES))]))
    after = Vector(lanes, builder.load(after_room))
    lanes.store(after, state, offset(T))
    return Vector(lanes, builder.load(weight_room)), after


@intrinsic
def blend(typing_context, state, polynomial, feature, index):
    """Blend one Gaussian into a tile, front to back.

    Args:
        typing_context: numba's, unused.
        state: (17, CHANNELS, 16) float32.
        polynomial: Six float32: c, lx, ly, A, B, C.
        feature: Four float32: red, green, blue, depth.
        index: float32, place of the Gaussian in the tile's list, kept in STOP where it finds the light spent.

    Returns:
        int64, zero if no pixel of the tile was lit before.
    """
    del typing_context
    signature = types.int64(state, _polynomial, _feature, types.float32)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        lanes = Builder(builder, LANES, "float32")
        features = [lanes.splat(builder.extract_value(args[2], k)) for k in range(4)]

        def body(offset: Any, row: Any, p: Vector, seen: Vector, t: Vector) -> None:
            weight, after = _pass_light(lanes, (p, seen, t), args[3], data, offset, row)
            for channel, value in zip((RED, GREEN, BLUE, DEPTH), features, strict=True):
                lanes.store(weight.times_plus(value, lanes.load(data, offset(channel))), data, offset(channel))
            # `after` is negative where light was spent without blending: that is no crossing.
            halved = t.compare(">", 0.5) & after.compare("<=", 0.5) & after.compare(">", 0.0)
            with builder.if_then(halved.any(), likely=False):
                lanes.store(halved.where(features[3], lanes.load(data, offset(MEDIAN))), data, offset(MEDIAN))

        return _emit_rows(builder, data, args[1], args[3], body)

    return signature, generate


@intrinsic
def weigh(typing_context, state, polynomial):
    """Like `blend` without colours: the largest and the summed weight over the tile.

    Args:
        typing_context: numba's, unused.
        state: (17, CHANNELS, 16) float32, of which only T and the gates are used.
        polynomial: Six float32: c, lx, ly, A, B, C.

    Returns:
        Three float32: largest and summed weight, and zero if no pixel of the tile was lit before.
    """
    del typing_context
    three = types.UniTuple(types.float32, 3)
    signature = three(state, _polynomial)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        lanes = Builder(builder, LANES, "float32")
        sums = [cgutils.alloca_once_value(builder, lanes.constant(0.0).value) for _ in range(2)]

        def body(offset: Any, row: Any, p: Vector, seen: Vector, t: Vector) -> None:
            weight, _ = _pass_light(lanes, (p, seen, t), ir.Constant(_F32, 0.0), data, offset, row)
            builder.store(Vector(lanes, builder.load(sums[0])).most(weight).value, sums[0])
            builder.store((Vector(lanes, builder.load(sums[1])) + weight).value, sums[1])

        lit = builder.uitofp(_emit_rows(builder, data, args[1], ir.Constant(_F32, 0.0), body), _F32)
        largest = Vector(lanes, builder.load(sums[0])).largest()
        return context.make_tuple(builder, three, [largest, Vector(lanes, builder.load(sums[1])).sum(), lit])

    return signature, generate


@intrinsic
def blend_backward(typing_context, state, polynomial, feature, centre, index):
    """Take one Gaussian out of a tile, back to front, and sum its gradients.

    The state holds the transmittance behind the Gaussian in T, the gradient of the loss by each channel in
    RED..DEPTH, and in MEDIAN the gradient-weighted light from behind, S.

    Args:
        typing_context: numba's, unused.
        state: (17, CHANNELS, 16) float32.
        polynomial: Six float32: c, lx, ly, A, B, C.
        feature: Four float32: red, green, blue, depth.
        centre: Two float32, the Gaussian's centre from the tile's first pixel.
        index: float32, place of the Gaussian in the tile's list; pixels whose STOP it reaches never blended it.

    Returns:
        Ten float32: gradients by red, green, blue, depth; then with q = dL/dalpha * alpha (0 where alpha is capped)
        and d = centre - pixel: sums of q, q dx, q dy, q dx^2, q dx dy, q dy^2.

    References:
        Chain rule through front-to-back blending: dL/dalpha_i = T_i c_i.v - S_i / (1 - alpha_i).
    """
    del typing_context
    ten = types.UniTuple(types.float32, 10)
    two = types.UniTuple(types.float32, 2)
    signature = ten(state, _polynomial, _feature, two, types.float32)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        lanes = Builder(builder, LANES, "float32")
        features = [lanes.splat(builder.extract_value(args[2], k)) for k in range(4)]
        dx = lanes.splat(builder.extract_value(args[3], 0)) - lanes.counting()
        below = _spilled(lanes, lanes.splat(builder.extract_value(args[3], 1)) - lanes.counting())
        place = lanes.splat(args[4])
        sums = [cgutils.alloca_once_value(builder, lanes.constant(0.0).value) for _ in range(10)]

        def add(k: int, value: Vector, factor: Vector) -> None:
            builder.store(value.times_plus(factor, Vector(lanes, builder.load(sums[k]))).value, sums[k])

        def body(offset: Any, row: Any, p: Vector, seen: Vector, t: Vector) -> None:
            response = p.exp2()
            alpha = response.least(0.999)
            live = seen & place.compare("<", lanes.load(data, offset(STOP)))
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
            dy = lanes.splat(_picked(builder, below, row))
            qx, qy, one = q * dx, q * dy, lanes.constant(1.0)
            for k, value, factor in ((4, q, one), (5, qx, one), (6, qy, one), (7, qx, dx), (8, qx, dy), (9, qy, dy)):
                add(k, value, factor)
            lanes.store(weight.times_plus(shine, behind), data, offset(MEDIAN))
            lanes.store(front, data, offset(T))

        _emit_rows(builder, data, args[1], args[4], body)
        return context.make_tuple(builder, ten, [Vector(lanes, builder.load(s)).sum() for s in sums])

    return signature, generate
