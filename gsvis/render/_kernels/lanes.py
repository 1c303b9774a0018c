"""Evaluate one Gaussian on one tile with explicit vectors: find its blocks, blend, weigh, and blend backward.

A tile is 16 x 16 pixels: 4 x 4 blocks, row by row, of 4 x 4 pixels, one vector each. A round Gaussian touches fewer of
these than of rows of 16 pixels. The state of a tile is (BLOCKS, CHANNELS, LANES) float32. A Gaussian comes as a record
of 16 float32: `p(x, y) = c + lx x + ly y + A x^2 + B x y + C y^2` = log2 alpha over the tile's pixels x, y = 0..15,
which float32 knows well where a pixel sees the Gaussian, however far its center lies; then red, green, blue, depth;
then the center from the tile's first pixel. A pixel whose transmittance is spent holds it negated.

Records and blocks are computed for a batch of Gaussians before they are blended: the branch predictor cannot foresee
the end of the loop over blocks, so what follows it must not depend on long computations.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from typing import Any, NamedTuple

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from gsvis._kernels.simd import Builder, Vector

__all__ = [
    "BLOCKS",
    "CHANNELS",
    "LANES",
    "LOG2_255",
    "RECORD",
    "SIDE",
    "STOP",
    "TILE",
    "Pixels",
    "Record",
    "T",
    "blend",
    "blend_backward",
    "darken",
    "find_reached_blocks",
    "gather",
    "load_channel",
    "store_channel",
    "take_out",
    "visit_blocks",
    "weigh",
]

SIDE = 4  # pixels of a block along each side, and blocks of a tile
LANES = SIDE * SIDE
BLOCKS = SIDE * SIDE
TILE = SIDE * SIDE  # pixels of a tile along each side
CHANNELS = 8
RECORD = 16
T, RED, GREEN, BLUE, DEPTH, MEDIAN, STOP = range(7)
"""Forward state. Backward reads T and STOP, and holds in RED..DEPTH the gradients, in MEDIAN what lies behind.

STOP is the place, in the tile's list, of the Gaussian that found the pixel's light spent, or inf.
"""

LOG2_255 = 7.994353436858858
"""A pixel sees a Gaussian where log2 alpha is at least the negative of this."""

_F32 = ir.FloatType()
_I64 = ir.IntType(64)

_COLUMNS = [[SIDE * (block % SIDE) + lane % SIDE for lane in range(LANES)] for block in range(BLOCKS)]
_ROWS = [[SIDE * (block // SIDE) + lane // SIDE for lane in range(LANES)] for block in range(BLOCKS)]


def _int(number: int) -> Any:
    return ir.Constant(_I64, number)


class Record:
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
def find_reached_blocks(typing_context, records, number, gates, place):
    """Return the blocks of a tile where alpha of the Gaussian reaches 1/255 and whose gate lies behind `place`.

    A block is reached if one of its rows of pixels is, between the centers of its first and its last pixel.

    Args:
        typing_context: numba's, unused.
        records: (K, 16) float32.
        number: Index of the record.
        gates: (BLOCKS,) float32, for each block the largest place at which one of its pixels may still be lit.
        place: float32, place of the Gaussian in the tile's list.

    Returns:
        int64, bit b set for block b.
    """
    del typing_context
    signature = types.int64(records, types.int64, gates, types.float32)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Emit the code."""
        lanes = Builder(builder, LANES, "float32")
        record = Record(context, lanes, sig.args[0], args[0], args[1])
        gates = context.make_array(sig.args[2])(context, builder, args[2]).data
        # A < 0: the dilation keeps every conic positive
        steep = lanes.splat(builder.fdiv(ir.Constant(_F32, -0.5), record.scalar(3)))
        left = lanes.constants([columns[0] for columns in _COLUMNS])
        right = lanes.constants([columns[-1] for columns in _COLUMNS])
        rows_most = []
        for row in range(SIDE):
            y = lanes.constants([rows[0] + row for rows in _ROWS])
            slope = y.times_plus(record[4], record[1])
            level = y.times_plus(record[5], record[2]).times_plus(y, record[0])
            peak = (slope * steep).most(left).least(right)
            rows_most.append(record[3].times_plus(peak, slope).times_plus(peak, level))
        most = reduce(Vector.most, rows_most)
        is_open = lanes.load(gates, _int(0)).compare(">", lanes.splat(args[3]))
        return (most.compare(">=", -LOG2_255) & is_open).bits()

    return signature, generate


class Pixels(NamedTuple):
    """The pixels of one block that a Gaussian reaches, one in each lane.

    Attributes:
        state: Place of the block's state.
        block: Its number, an int64.
        x: Column in the tile.
        y: Row in the tile.
        p: log2 alpha.
        seen: Mask of the lit pixels with alpha >= 1/255.
        t: Transmittance.
    """

    state: Any
    block: Any
    x: Vector
    y: Vector
    p: Vector
    seen: Vector
    t: Vector


def visit_blocks(lanes: Builder, state: Any, record: Record, todo: Any, body: Callable[[Pixels], None]) -> None:
    """Call `body` for each block in `todo` in which a lit pixel sees the Gaussian."""
    builder = lanes.ir
    columns = lanes.table("columns", _COLUMNS)
    rows = lanes.table("rows", _ROWS)
    before = builder.block
    head, inside, after = (builder.append_basic_block(name) for name in ("blocks", "block", "done"))
    builder.branch(head)
    builder.position_at_end(head)
    left = builder.phi(_I64)
    left.add_incoming(todo, before)
    builder.cbranch(builder.icmp_unsigned("!=", left, _int(0)), inside, after)
    builder.position_at_end(inside)
    block = builder.cttz(left, ir.Constant(ir.IntType(1), 1))
    here = builder.gep(state, [builder.mul(block, _int(CHANNELS * LANES))])
    first = builder.mul(block, _int(LANES))
    x = lanes.load(columns, first)
    y = lanes.load(rows, first)
    along = record[3].times_plus(x, record[1]).times_plus(x, record[0])
    across = record[4].times_plus(x, record[2])
    p = record[5].times_plus(y, across).times_plus(y, along)
    t = lanes.load(here, _int(T * LANES))
    seen = p.compare(">=", -LOG2_255) & t.compare(">", 0.0)
    with builder.if_then(seen.any(), likely=True):
        body(Pixels(here, block, x, y, p, seen, t))
    left.add_incoming(builder.and_(left, builder.sub(left, _int(1))), builder.block)
    builder.branch(head)
    builder.position_at_end(after)


def load_channel(lanes: Builder, state: Any, channel: int) -> Vector:
    """Return the vector of a channel of a block."""
    return lanes.load(state, _int(channel * LANES))


def store_channel(lanes: Builder, vector: Vector, state: Any, channel: int) -> None:
    """Store a vector as a channel of a block."""
    lanes.store(vector, state, _int(channel * LANES))


def _pass_light(lanes: Builder, pixels: Pixels, place: Any, lit: Any) -> tuple[Vector, Vector]:
    """Return the weight of the Gaussian and the light it leaves, and store that light.

    A pixel that would fall to 1e-4 blends nothing: its light is kept negated and the place of the Gaussian in STOP.
    That stands behind no branch: a predictor cannot foresee it.
    """
    t = pixels.t
    share = pixels.seen.where(pixels.p.exp2().least(0.999), 0.0) * t
    after = t - share
    spent = pixels.seen & after.compare("<=", 1e-4)
    after = spent.where(t * -1.0, after)
    store_channel(lanes, spent.where(lanes.splat(place), load_channel(lanes, pixels.state, STOP)), pixels.state, STOP)
    store_channel(lanes, after, pixels.state, T)
    darken(lanes, pixels.block, after, lit)
    return spent.where(0.0, share), after


def darken(lanes: Builder, block: Any, light: Vector, lit: Any) -> None:
    """Clear the bit of a block in `lit` if none of its pixels has light."""
    builder = lanes.ir
    with builder.if_then(builder.not_(light.compare(">", 0.0).any()), likely=False):
        builder.store(builder.and_(builder.load(lit), builder.not_(builder.shl(_int(1), block))), lit)


@intrinsic
def blend(typing_context, state, records, number, todo, lit, place):
    """Blend one Gaussian into a tile, front to back.

    Args:
        typing_context: numba's, unused.
        state: (BLOCKS, CHANNELS, LANES) float32.
        records: (K, 16) float32.
        number: Which record.
        todo: int64, blocks to blend it into.
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
        features = [record[6 + k] for k in range(4)]

        def body(pixels: Pixels) -> None:
            """Emit the code for one block."""
            weight, after = _pass_light(lanes, pixels, args[5], lit_blocks)
            for channel, value in zip((RED, GREEN, BLUE, DEPTH), features, strict=True):
                held = load_channel(lanes, pixels.state, channel)
                store_channel(lanes, weight.times_plus(value, held), pixels.state, channel)
            # `after` is negative where light was spent without blending: that is no crossing.
            halved = pixels.t.compare(">", 0.5) & after.compare("<=", 0.5) & after.compare(">", 0.0)
            median = halved.where(features[3], load_channel(lanes, pixels.state, MEDIAN))
            store_channel(lanes, median, pixels.state, MEDIAN)

        visit_blocks(lanes, data, record, args[3], body)
        return context.get_dummy_value()

    return signature, generate


@intrinsic
def weigh(typing_context, state, records, number, todo, lit):
    """Return the largest and the summed weight of one Gaussian over the tile; like `blend`, without colors.

    Args:
        typing_context: numba's, unused.
        state: (BLOCKS, CHANNELS, LANES) float32, of which T alone is used.
        records: (K, 16) float32.
        number: Which record.
        todo: int64, blocks to take it into.
        lit: (1,) int64, blocks with light left; bits are cleared as it is spent.

    Returns:
        Two float32.
    """
    del typing_context
    pair = types.UniTuple(types.float32, 2)
    signature = pair(state, records, types.int64, types.int64, lit)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Emit the code."""
        data, lit_blocks = (context.make_array(sig.args[k])(context, builder, args[k]).data for k in (0, 4))
        lanes = Builder(builder, LANES, "float32")
        record = Record(context, lanes, sig.args[1], args[1], args[2])
        largest, total = (cgutils.alloca_once_value(builder, lanes.constant(0.0).value) for _ in range(2))

        def body(pixels: Pixels) -> None:
            """Emit the code for one block."""
            weight, _ = _pass_light(lanes, pixels, ir.Constant(_F32, 0.0), lit_blocks)
            builder.store(Vector(lanes, builder.load(largest)).most(weight).value, largest)
            builder.store((Vector(lanes, builder.load(total)) + weight).value, total)

        visit_blocks(lanes, data, record, args[3], body)
        results = [Vector(lanes, builder.load(largest)).largest(), Vector(lanes, builder.load(total)).sum()]
        return context.make_tuple(builder, pair, results)

    return signature, generate


@intrinsic
def gather(typing_context, state, records, number, todo, lit, sums, pair):
    """Sum what the pixels of a tile hold in RED, GREEN and BLUE, times the weight of one Gaussian, front to back.

    Args:
        typing_context: numba's, unused.
        state: (BLOCKS, CHANNELS, LANES) float32; RED, GREEN and BLUE stay as they are.
        records: (K, 16) float32.
        number: Which record.
        todo: int64, blocks to take it into.
        lit: (1,) int64, blocks with light left; bits are cleared as it is spent.
        sums: (P, 4) float32, receives the three sums and a zero in row `pair`.
        pair: Which row.
    """
    del typing_context
    signature = types.void(state, records, types.int64, types.int64, lit, sums, types.int64)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Emit the code."""
        data, lit_blocks, out = (context.make_array(sig.args[k])(context, builder, args[k]).data for k in (0, 4, 5))
        lanes = Builder(builder, LANES, "float32")
        record = Record(context, lanes, sig.args[1], args[1], args[2])
        rooms = [cgutils.alloca_once_value(builder, lanes.constant(0.0).value) for _ in range(3)]

        def body(pixels: Pixels) -> None:
            """Emit the code for one block."""
            weight, _ = _pass_light(lanes, pixels, ir.Constant(_F32, 0.0), lit_blocks)
            for room, channel in zip(rooms, (RED, GREEN, BLUE), strict=True):
                held = Vector(lanes, builder.load(room))
                builder.store(weight.times_plus(load_channel(lanes, pixels.state, channel), held).value, room)

        visit_blocks(lanes, data, record, args[3], body)
        totals = lanes.sums([Vector(lanes, builder.load(room)) for room in rooms])
        lanes.store_first(totals, 4, out, builder.mul(args[6], _int(4)))
        return context.get_dummy_value()

    return signature, generate


class _TakenOut(NamedTuple):
    """One block of a Gaussian that is taken out of a tile, each pixel in a lane.

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


def _take_out_of_block(lanes: Builder, record: Record, place: Vector, pixels: Pixels) -> _TakenOut:
    """Take a Gaussian out of a block: store the light in front of it, and add its own to the light from behind."""
    state = pixels.state
    response = pixels.p.exp2()
    live = pixels.seen & place.compare("<", load_channel(lanes, state, STOP))
    alpha = live.where(response.least(0.999), 0.0)
    opening = lanes.constant(1.0) / (lanes.constant(1.0) - alpha)
    front = pixels.t * opening
    gradients = [load_channel(lanes, state, channel) for channel in (RED, GREEN, BLUE, DEPTH)]
    shine = record[6] * gradients[0]
    for k in range(1, 4):
        shine = record[6 + k].times_plus(gradients[k], shine)
    weight = alpha * front
    behind = load_channel(lanes, state, MEDIAN)
    store_channel(lanes, weight.times_plus(shine, behind), state, MEDIAN)
    store_channel(lanes, front, state, T)
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
        record = Record(context, lanes, sig.args[1], args[1], args[2])
        place = lanes.splat(args[4])

        def body(pixels: Pixels) -> None:
            """Emit the code for one block."""
            _take_out_of_block(lanes, record, place, pixels)

        visit_blocks(lanes, data, record, args[3], body)
        return context.get_dummy_value()

    return signature, generate


@intrinsic
def blend_backward(typing_context, state, records, number, todo, place, sums, pair):
    """Take one Gaussian out of a tile, back to front, and sum its gradients.

    The state holds the transmittance behind the Gaussian in T, the gradient of the loss by each channel in
    RED..DEPTH, and in MEDIAN the gradient-weighted light from behind, S.

    Args:
        typing_context: numba's, unused.
        state: (BLOCKS, CHANNELS, LANES) float32.
        records: (K, 16) float32.
        number: Which record.
        todo: int64, blocks to take it out of.
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
        record = Record(context, lanes, sig.args[1], args[1], args[2])
        center_x = record[10]
        center_y = record[11]
        place = lanes.splat(args[4])
        rooms = [cgutils.alloca_once_value(builder, lanes.constant(0.0).value) for _ in range(10)]

        def add(k: int, value: Vector, factor: Vector | None = None) -> None:
            """Add a vector, times a factor if given, to sum k."""
            held = Vector(lanes, builder.load(rooms[k]))
            builder.store((held + value if factor is None else value.times_plus(factor, held)).value, rooms[k])

        def body(pixels: Pixels) -> None:
            """Emit the code for one block."""
            out = _take_out_of_block(lanes, record, place, pixels)
            by_alpha = out.front * out.shine - out.opening * out.behind
            for k, gradient in enumerate(out.gradients):
                add(k, out.weight, gradient)
            q = (out.live & out.response.compare("<", 0.999)).where(by_alpha * out.response, 0.0)
            dx = center_x - pixels.x
            dy = center_y - pixels.y
            qx = q * dx
            qy = q * dy
            add(4, q)
            add(5, qx)
            add(6, qy)
            add(7, qx, dx)
            add(8, qx, dy)
            add(9, qy, dy)

        visit_blocks(lanes, data, record, args[3], body)
        totals = lanes.sums([Vector(lanes, builder.load(room)) for room in rooms])
        lanes.store_first(totals, 12, totals_at, builder.mul(args[6], _int(12)))
        return context.get_dummy_value()

    return signature, generate
