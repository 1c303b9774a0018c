"""Evaluate one Gaussian on one tile with explicit vectors: find its rows, blend, weigh, and blend backward.

A tile is 16 pixels wide, one vector, and 16 rows high. Its state is (16, CHANNELS, 16) float32. A Gaussian comes as a
record of 16 float32: `p(x, y) = c + lx x + ly y + A x^2 + B x y + C y^2` = log2 alpha over the tile's pixels
x, y = 0..15, which float32 knows well where a pixel sees the Gaussian, however far its center lies; then red, green,
blue, depth; then the center from the tile's first pixel. A pixel whose transmittance is spent holds it negated.

Records and rows are computed for a batch of Gaussians before they are blended: the branch predictor cannot foresee
the end of the loop over rows, so what follows it must not depend on long computations.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from gsvis._kernels.simd import Builder, Vector

__all__ = ["CHANNELS", "LANES", "RECORD", "blend", "blend_backward", "find_reached_rows", "gather", "take_out", "weigh"]

LANES = 16
CHANNELS = 8
RECORD = 16
T, RED, GREEN, BLUE, DEPTH, MEDIAN, STOP = range(7)
"""Forward state. Backward reads T and STOP, and holds in RED..DEPTH the gradients, in MEDIAN what lies behind.

STOP is the place, in the tile's list, of the Gaussian that found the pixel's light spent, or inf.
"""

_LOG2_255 = 7.994353436858858
_F32 = ir.FloatType()
_I64 = ir.IntType(64)

_RowBody = Callable[[Any, Vector, Vector, Vector, Vector], None]


def _int(number: int) -> Any:
    return ir.Constant(_I64, number)


class _Record:
    """The record of one Gaussian, in the function under construction."""

    def __init__(self, context: Any, lanes: Builder, array_type: Any, array: Any, number: Any) -> None:
        self._lanes = lanes
        data = context.make_array(array_type)(context, lanes.ir, array).data
        self._first = lanes.ir.gep(data, [lanes.ir.mul(number, _int(RECORD))])

    def scalar(self, k: int) -> Any:
        """Return entry k."""
        return self._lanes.ir.load(self._lanes.ir.gep(self._first, [_int(k)]))

    def __getitem__(self, k: int) -> Vector:
        """Return entry k in all lanes."""
        return self._lanes.splat(self.scalar(k))


@intrinsic
def find_reached_rows(typing_context, records, number, gates, place):
    """Return the rows of a tile where alpha of the Gaussian reaches 1/255 and whose gate lies behind `place`.

    Args:
        typing_context: numba's, unused.
        records: (K, 16) float32.
        number: Index of the record.
        gates: (16,) float32, for each row the largest place at which one of its pixels may still be lit.
        place: float32, place of the Gaussian in the tile's list.

    Returns:
        int64, bit y set for row y.
    """
    del typing_context
    signature = types.int64(records, types.int64, gates, types.float32)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Emit the code."""
        lanes = Builder(builder, LANES, "float32")
        record = _Record(context, lanes, sig.args[0], args[0], args[1])
        gates = context.make_array(sig.args[2])(context, builder, args[2]).data
        y = lanes.counting()
        slope = y.times_plus(record[4], record[1])
        level = y.times_plus(record[5], record[2]).times_plus(y, record[0])
        # A < 0: the dilation keeps every conic positive
        peak = (slope * lanes.splat(builder.fdiv(ir.Constant(_F32, -0.5), record.scalar(3)))).most(0.0)
        peak = peak.least(LANES - 1.0)
        most = record[3].times_plus(peak, slope).times_plus(peak, level)
        is_open = lanes.load(gates, _int(0)).compare(">", lanes.splat(args[3]))
        return (most.compare(">=", -_LOG2_255) & is_open).bits()

    return signature, generate


def _each_row(lanes: Builder, state: Any, record: _Record, todo: Any, body: _RowBody) -> None:
    """Call `body(row, y, p, seen, t)` for each row in `todo` in which a lit pixel sees the Gaussian.

    `row` is the place of the row's state, `y` its number in all lanes, `p` log2 alpha, `seen` the mask of lit pixels
    with alpha >= 1/255, `t` the transmittance.
    """
    builder = lanes.ir
    x = lanes.counting()
    along = record[3].times_plus(x, record[1]).times_plus(x, record[0])
    across = record[4].times_plus(x, record[2])
    square = record[5]
    before = builder.block
    head, inside, after = (builder.append_basic_block(name) for name in ("rows", "row", "done"))
    builder.branch(head)
    builder.position_at_end(head)
    left = builder.phi(_I64)
    left.add_incoming(todo, before)
    builder.cbranch(builder.icmp_unsigned("!=", left, _int(0)), inside, after)
    builder.position_at_end(inside)
    number = builder.cttz(left, ir.Constant(ir.IntType(1), 1))
    row = builder.gep(state, [builder.mul(number, _int(CHANNELS * LANES))])
    y = lanes.splat(builder.sitofp(number, _F32))
    p = square.times_plus(y, across).times_plus(y, along)
    t = lanes.load(row, _int(T * LANES))
    seen = p.compare(">=", -_LOG2_255) & t.compare(">", 0.0)
    with builder.if_then(seen.any(), likely=True):
        body(row, y, p, seen, t)
    left.add_incoming(builder.and_(left, builder.sub(left, _int(1))), builder.block)
    builder.branch(head)
    builder.position_at_end(after)


def _load(lanes: Builder, row: Any, channel: int) -> Vector:
    """Return the vector of a channel of a row."""
    return lanes.load(row, _int(channel * LANES))


def _store(lanes: Builder, vector: Vector, row: Any, channel: int) -> None:
    """Store a vector as a channel of a row."""
    lanes.store(vector, row, _int(channel * LANES))


def _pass_light(
    lanes: Builder, pixels: tuple[Vector, Vector, Vector, Vector], row: Any, place: Any, lit: Any
) -> tuple[Vector, Vector]:
    """Return the weight of the Gaussian and the light it leaves, and store that light.

    `pixels` is (y, p, seen, t) as `_each_row` gives them. A pixel that would fall to 1e-4 blends nothing: its light is
    kept negated and the place of the Gaussian in STOP; the bit of its row in `lit` is cleared if it was the last one
    lit. That happens once a pixel, so it stands behind a branch.
    """
    builder = lanes.ir
    y, p, seen, t = pixels
    share = seen.where(p.exp2().least(0.999), 0.0) * t
    after = t - share
    weight_room, after_room = (cgutils.alloca_once(builder, lanes.type) for _ in range(2))
    builder.store(share.value, weight_room)
    builder.store(after.value, after_room)
    spent = seen & after.compare("<=", 1e-4)
    with builder.if_then(spent.any(), likely=False):
        left = spent.where(t * -1.0, after)
        builder.store(spent.where(0.0, share).value, weight_room)
        builder.store(left.value, after_room)
        _store(lanes, spent.where(lanes.splat(place), _load(lanes, row, STOP)), row, STOP)
        number = builder.fptoui(builder.extract_element(y.value, ir.Constant(ir.IntType(32), 0)), _I64)
        still = builder.select(left.compare(">", 0.0).any(), _int(0), builder.shl(_int(1), number))
        builder.store(builder.and_(builder.load(lit), builder.not_(still)), lit)
    after = Vector(lanes, builder.load(after_room))
    _store(lanes, after, row, T)
    return Vector(lanes, builder.load(weight_room)), after


@intrinsic
def blend(typing_context, state, records, number, todo, lit, place):
    """Blend one Gaussian into a tile, front to back.

    Args:
        typing_context: numba's, unused.
        state: (16, CHANNELS, 16) float32.
        records: (K, 16) float32.
        number: Which record.
        todo: int64, rows to blend it into.
        lit: (1,) int64, rows with light left; bits are cleared as it is spent.
        place: float32, place of the Gaussian in the tile's list.
    """
    del typing_context
    signature = types.void(state, records, types.int64, types.int64, lit, types.float32)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Emit the code."""
        data, lit_rows = (context.make_array(sig.args[k])(context, builder, args[k]).data for k in (0, 4))
        lanes = Builder(builder, LANES, "float32")
        record = _Record(context, lanes, sig.args[1], args[1], args[2])
        features = [record[6 + k] for k in range(4)]

        def body(row: Any, y: Vector, p: Vector, seen: Vector, t: Vector) -> None:
            """Emit the code for one row."""
            weight, after = _pass_light(lanes, (y, p, seen, t), row, args[5], lit_rows)
            for channel, value in zip((RED, GREEN, BLUE, DEPTH), features, strict=True):
                _store(lanes, weight.times_plus(value, _load(lanes, row, channel)), row, channel)
            # `after` is negative where light was spent without blending: that is no crossing.
            halved = t.compare(">", 0.5) & after.compare("<=", 0.5) & after.compare(">", 0.0)
            with builder.if_then(halved.any(), likely=False):
                _store(lanes, halved.where(features[3], _load(lanes, row, MEDIAN)), row, MEDIAN)

        _each_row(lanes, data, record, args[3], body)
        return context.get_dummy_value()

    return signature, generate


@intrinsic
def weigh(typing_context, state, records, number, todo, lit):
    """Return the largest and the summed weight of one Gaussian over the tile; like `blend`, without colors.

    Args:
        typing_context: numba's, unused.
        state: (16, CHANNELS, 16) float32, of which T alone is used.
        records: (K, 16) float32.
        number: Which record.
        todo: int64, rows to take it into.
        lit: (1,) int64, rows with light left; bits are cleared as it is spent.

    Returns:
        Two float32.
    """
    del typing_context
    pair = types.UniTuple(types.float32, 2)
    signature = pair(state, records, types.int64, types.int64, lit)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Emit the code."""
        data, lit_rows = (context.make_array(sig.args[k])(context, builder, args[k]).data for k in (0, 4))
        lanes = Builder(builder, LANES, "float32")
        record = _Record(context, lanes, sig.args[1], args[1], args[2])
        largest, total = (cgutils.alloca_once_value(builder, lanes.constant(0.0).value) for _ in range(2))

        def body(row: Any, y: Vector, p: Vector, seen: Vector, t: Vector) -> None:
            """Emit the code for one row."""
            weight, _ = _pass_light(lanes, (y, p, seen, t), row, ir.Constant(_F32, 0.0), lit_rows)
            builder.store(Vector(lanes, builder.load(largest)).most(weight).value, largest)
            builder.store((Vector(lanes, builder.load(total)) + weight).value, total)

        _each_row(lanes, data, record, args[3], body)
        results = [Vector(lanes, builder.load(largest)).largest(), Vector(lanes, builder.load(total)).sum()]
        return context.make_tuple(builder, pair, results)

    return signature, generate


@intrinsic
def gather(typing_context, state, records, number, todo, lit, sums, pair):
    """Sum what the pixels of a tile hold in RED, GREEN and BLUE, times the weight of one Gaussian, front to back.

    Args:
        typing_context: numba's, unused.
        state: (16, CHANNELS, 16) float32; RED, GREEN and BLUE stay as they are.
        records: (K, 16) float32.
        number: Which record.
        todo: int64, rows to take it into.
        lit: (1,) int64, rows with light left; bits are cleared as it is spent.
        sums: (P, 4) float32, receives the three sums and a zero in row `pair`.
        pair: Which row.
    """
    del typing_context
    signature = types.void(state, records, types.int64, types.int64, lit, sums, types.int64)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Emit the code."""
        data, lit_rows, out = (context.make_array(sig.args[k])(context, builder, args[k]).data for k in (0, 4, 5))
        lanes = Builder(builder, LANES, "float32")
        record = _Record(context, lanes, sig.args[1], args[1], args[2])
        rooms = [cgutils.alloca_once_value(builder, lanes.constant(0.0).value) for _ in range(3)]

        def body(row: Any, y: Vector, p: Vector, seen: Vector, t: Vector) -> None:
            """Emit the code for one row."""
            weight, _ = _pass_light(lanes, (y, p, seen, t), row, ir.Constant(_F32, 0.0), lit_rows)
            for room, channel in zip(rooms, (RED, GREEN, BLUE), strict=True):
                held = Vector(lanes, builder.load(room))
                builder.store(weight.times_plus(_load(lanes, row, channel), held).value, room)

        _each_row(lanes, data, record, args[3], body)
        totals = lanes.sums([Vector(lanes, builder.load(room)) for room in rooms])
        lanes.store_first(totals, 4, out, builder.mul(args[6], _int(4)))
        return context.get_dummy_value()

    return signature, generate


class _TakenOut(NamedTuple):
    """One row of a Gaussian that is taken out of a tile, each pixel in a lane.

    Attributes:
        live: Mask of the pixels that blended it.
        response: Alpha, before it is capped.
        weight: Of the Gaussian.
        front: Light in front of it.
        opening: One over the share of light that it lets pass.
        gradients: Of the loss by each channel.
        shine: Gradient of the loss by the weight.
        behind: Gradient-weighted light from behind.
    """

    live: Vector
    response: Vector
    weight: Vector
    front: Vector
    opening: Vector
    gradients: list[Vector]
    shine: Vector
    behind: Vector


def _take_out_of_row(
    lanes: Builder, row: Any, record: _Record, place: Vector, pixels: tuple[Vector, Vector, Vector]
) -> _TakenOut:
    """Take a Gaussian out of a row: store the light in front of it, and add its own to the light from behind.

    `pixels` is (p, seen, t) as `_each_row` gives them.
    """
    p, seen, t = pixels
    response = p.exp2()
    live = seen & place.compare("<", _load(lanes, row, STOP))
    alpha = live.where(response.least(0.999), 0.0)
    opening = lanes.constant(1.0) / (lanes.constant(1.0) - alpha)
    front = t * opening
    gradients = [_load(lanes, row, channel) for channel in (RED, GREEN, BLUE, DEPTH)]
    shine = record[6] * gradients[0]
    for k in range(1, 4):
        shine = record[6 + k].times_plus(gradients[k], shine)
    weight = alpha * front
    behind = _load(lanes, row, MEDIAN)
    _store(lanes, weight.times_plus(shine, behind), row, MEDIAN)
    _store(lanes, front, row, T)
    return _TakenOut(live, response, weight, front, opening, gradients, shine, behind)


@intrinsic
def take_out(typing_context, state, records, number, todo, place):
    """Take one Gaussian that gets no gradients out of a tile, back to front: `blend_backward` without the sums."""
    del typing_context
    signature = types.void(state, records, types.int64, types.int64, types.float32)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Emit the code."""
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        lanes = Builder(builder, LANES, "float32")
        record = _Record(context, lanes, sig.args[1], args[1], args[2])
        place = lanes.splat(args[4])

        def body(row: Any, y: Vector, p: Vector, seen: Vector, t: Vector) -> None:
            """Emit the code for one row."""
            _take_out_of_row(lanes, row, record, place, (p, seen, t))

        _each_row(lanes, data, record, args[3], body)
        return context.get_dummy_value()

    return signature, generate


@intrinsic
def blend_backward(typing_context, state, records, number, todo, place, sums, pair):
    """Take one Gaussian out of a tile, back to front, and sum its gradients.

    The state holds the transmittance behind the Gaussian in T, the gradient of the loss by each channel in
    RED..DEPTH, and in MEDIAN the gradient-weighted light from behind, S.

    Args:
        typing_context: numba's, unused.
        state: (16, CHANNELS, 16) float32.
        records: (K, 16) float32.
        number: Which record.
        todo: int64, rows to take it out of.
        place: float32, place of the Gaussian in the tile's list; pixels whose STOP it reaches never blended it.
        sums: (P, 12) float32, receives in row `pair` the gradients by red, green, blue, depth; then, with
            q = dL/dalpha * alpha (0 where alpha is capped) and d = center - pixel, the sums of q, q dx, q dy, q dx^2,
            q dx dy, q dy^2; and two zeros.
        pair: Which row.

    References:
        Chain rule through front-to-back blending: dL/dalpha_i = T_i c_i.v - S_i / (1 - alpha_i).
    """
    del typing_context
    signature = types.void(state, records, types.int64, types.int64, types.float32, sums, types.int64)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Emit the code."""
        data, totals_at = (context.make_array(sig.args[k])(context, builder, args[k]).data for k in (0, 5))
        lanes = Builder(builder, LANES, "float32")
        record = _Record(context, lanes, sig.args[1], args[1], args[2])
        dx = record[10] - lanes.counting()
        center_y = record[11]
        place = lanes.splat(args[4])
        rooms = [cgutils.alloca_once_value(builder, lanes.constant(0.0).value) for _ in range(10)]

        def add(k: int, value: Vector, factor: Vector | None = None) -> None:
            """Add a vector, times a factor if given, to sum k."""
            held = Vector(lanes, builder.load(rooms[k]))
            builder.store((held + value if factor is None else value.times_plus(factor, held)).value, rooms[k])

        def body(row: Any, y: Vector, p: Vector, seen: Vector, t: Vector) -> None:
            """Emit the code for one row."""
            out = _take_out_of_row(lanes, row, record, place, (p, seen, t))
            by_alpha = out.front * out.shine - out.opening * out.behind
            for k, gradient in enumerate(out.gradients):
                add(k, out.weight, gradient)
            q = (out.live & out.response.compare("<", 0.999)).where(by_alpha * out.response, 0.0)
            dy = center_y - y
            qx = q * dx
            qy = q * dy
            add(4, q)
            add(5, qx)
            add(6, qy)
            add(7, qx, dx)
            add(8, qx, dy)
            add(9, qy, dy)

        _each_row(lanes, data, record, args[3], body)
        totals = lanes.sums([Vector(lanes, builder.load(room)) for room in rooms])
        lanes.store_first(totals, 12, totals_at, builder.mul(args[6], _int(12)))
        return context.get_dummy_value()

    return signature, generate
