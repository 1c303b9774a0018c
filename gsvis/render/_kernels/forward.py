"""Pass Gaussians through one block of a tile, front to back, with its pixels in registers: blend, weigh, gather.

Light only falls, so that where it is spent it stays so: what follows needs no memory of it. A pixel that would fall to
1e-4 blends nothing.

A processor sees some hundred instructions ahead. One Gaussian after the other, the chain from a record to its alpha
would fill that; so the alphas of several are computed side by side, as one wide vector, and taken one by one.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from gsvis._kernels.simd import Builder, Vector, loop_over_bits, without_lowest
from gsvis.render._kernels.lanes import (
    BATCH,
    BLOCKS,
    BLUE,
    GREEN,
    LANES,
    LOG2_255,
    PLACE,
    RED,
    STOP,
    Record,
    T,
    as_int,
    block_of,
    darken,
    load_channel,
    store_channel,
)

__all__ = [
    "Block",
    "Held",
    "blend",
    "freeze",
    "gather",
    "list_by_block",
    "place_of",
    "take_sums",
    "take_weight",
    "weigh",
]

TOGETHER = 4  # Gaussians whose alphas are computed side by side
_I64 = ir.IntType(64)
_SPENT = 1e-4

Held = list[Vector]


@intrinsic
def list_by_block(typing_context, todo, count, members):
    """Turn the reached blocks of Gaussians into the Gaussians of each block.

    Args:
        typing_context: numba's, unused.
        todo: (K,) int64, for each Gaussian the blocks it reaches, as bits.
        count: Number of Gaussians, at most 64.
        members: (BLOCKS,) int64, receives for each block its Gaussians, as bits.
    """
    del typing_context
    signature = types.void(todo, types.int64, members)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Emit the code."""
        blocks, out = (context.make_array(sig.args[k])(context, builder, args[k]).data for k in (0, 2))
        kind = ir.VectorType(_I64, BLOCKS)
        none = ir.Constant(kind, [0] * BLOCKS)
        found = cgutils.alloca_once_value(builder, none)
        one = cgutils.alloca_once_value(builder, ir.Constant(kind, [1] * BLOCKS))
        with cgutils.for_range(builder, args[1]) as loop:
            reached = builder.trunc(builder.load(builder.gep(blocks, [loop.index])), ir.IntType(BLOCKS))
            mask = builder.bitcast(reached, ir.VectorType(ir.IntType(1), BLOCKS))
            bit = builder.load(one)
            builder.store(builder.or_(builder.load(found), builder.select(mask, bit, none)), found)
            builder.store(builder.add(bit, bit), one)
        builder.store(builder.load(found), builder.bitcast(out, kind.as_pointer()), align=4)
        return context.get_dummy_value()

    return signature, generate


class Block:
    """One block of a tile with Gaussians to pass, in the function under construction.

    Args:
        context: The typing context of the function.
        builder: Its builder.
        sig: Its signature, of which the first four arguments are: the state (BLOCKS, CHANNELS, LANES) float32; int64,
            the number of the block; the records (BATCH + 1, RECORD) float32, of which the last reaches nothing; and
            int64, the records to pass, as bits.
        args: Its arguments.
    """

    def __init__(self, context: Any, builder: Any, sig: Any, args: Any) -> None:
        self.lanes = Builder(builder, LANES, "float32")
        state = context.make_array(sig.args[0])(context, builder, args[0]).data
        self._number = args[1]
        self._members = args[3]
        here, x, y = block_of(self.lanes, state, args[1])
        self._here = here
        self._pixels = x, y
        self._record = partial(Record, context, self.lanes, sig.args[2], args[2])

    def load(self, channel: int) -> Vector:
        """Return the vector of a channel."""
        return load_channel(self.lanes, self._here, channel)

    def store(self, vector: Vector, channel: int) -> None:
        """Store a vector as a channel."""
        store_channel(self.lanes, vector, self._here, channel)

    def end(self, light: Vector, lit: Any) -> None:
        """Store the light that is left, and clear the bit of the block in `lit` if there is none."""
        self.store(light, T)
        darken(self.lanes, self._number, light, lit)

    def pass_members(
        self, given: Held, body: Callable[[Any, Record, Vector, Held], Held], *, backward: bool = False
    ) -> Held:
        """Emit a loop over the Gaussians, and return the vectors that it ends with.

        Args:
            given: The vectors to begin with.
            body: Returns the vectors behind one more Gaussian, from its number, its record, its alpha at the pixels,
                and the vectors in front. It is also called for records that reach nothing.
            backward: Take the Gaussians from the last to the first.
        """
        builder = self.lanes.ir

        def turn(left: Any, held: Held) -> tuple[Any, Held]:
            """Pass the next few."""
            numbers = []
            for _ in range(TOGETHER):
                number, left = (_take_last if backward else _take_first)(builder, left)
                numbers.append(number)
            some = [self._record(number) for number in numbers]
            for number, record, alpha in zip(numbers, some, _find_alphas(self.lanes, some, *self._pixels), strict=True):
                held = body(number, record, alpha, held)
            return left, held

        return loop_over_bits(builder, self._members, given, turn)


def freeze(light: Vector, left: Vector, spent: float) -> Vector:
    """Return the light of pixels, negated where the falling light lies at or below `spent`."""
    return light.compare(">", spent).where(left, left.most(left * -1.0) * -1.0)


def place_of(builder: Any, number: Any, sums: int, k: int) -> Any:
    """Return where in an array (BATCH + 1, sums, LANES) sum k of a record begins."""
    return builder.add(builder.mul(number, as_int(sums * LANES)), as_int(k * LANES))


def _take_first(builder: Any, members: Any) -> tuple[Any, Any]:
    """Return the lowest number among members, or BATCH, and the members without it."""
    return builder.cttz(members, ir.Constant(ir.IntType(1), 0)), without_lowest(builder, members)


def _take_last(builder: Any, members: Any) -> tuple[Any, Any]:
    """Return the highest number among members, or BATCH, and the members without it."""
    number = builder.sub(as_int(BATCH - 1), builder.ctlz(members, ir.Constant(ir.IntType(1), 0)))
    is_none = builder.icmp_unsigned("==", members, as_int(0))
    bit = builder.shl(as_int(1), builder.and_(number, as_int(BATCH - 1)))
    return builder.select(is_none, as_int(BATCH), number), builder.and_(members, builder.not_(bit))


def _find_alphas(lanes: Builder, records: list[Record], x: Vector, y: Vector) -> Held:
    """Return the alpha of each Gaussian at pixels, 0 below 1/255."""
    wide = Builder(lanes.ir, LANES * len(records), "float32")

    def each(k: int) -> Vector:
        """Return entry k of all records."""
        return wide.join([record[k] for record in records])

    xs = wide.join([x] * len(records))
    ys = wide.join([y] * len(records))
    along = each(3).times_plus(xs, each(1)).times_plus(xs, each(0))
    across = each(4).times_plus(xs, each(2))
    p = each(5).times_plus(ys, across).times_plus(ys, along)
    alpha = p.compare(">=", -LOG2_255).where(p.exp2(bounded=False).least(0.999), 0.0)
    return lanes.parts(alpha)


def _take(alpha: Vector, light: Vector) -> tuple[Vector, Vector, Vector]:
    """Return the weight of a Gaussian, the light behind it, and the mask of the pixels where that is not spent."""
    share = alpha * light
    after = light - share
    is_lit = after.compare(">", _SPENT)
    return is_lit.where(share, 0.0), after, is_lit


@intrinsic
def blend(typing_context, state, block, records, members, lit):
    """Blend Gaussians into one block of a tile.

    A pixel whose light is spent keeps it negated, and in STOP the place behind the last Gaussian that it blended, or
    passed lit. MEDIAN receives the depth of the last Gaussian that found a pixel with more than half its light.

    Args:
        typing_context: numba's, unused.
        state: (BLOCKS, CHANNELS, LANES) float32.
        block: Number of the block.
        records: (BATCH + 1, RECORD) float32; the last reaches nothing.
        members: int64, the records to blend, as bits.
        lit: (1,) int64, blocks with light left; the bit is cleared if it is spent.
    """
    del typing_context
    signature = types.void(state, types.int64, records, types.int64, lit)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Emit the code."""
        lit_blocks = context.make_array(sig.args[4])(context, builder, args[4]).data
        part = Block(context, builder, sig, args)
        given = [part.load(channel) for channel in range(STOP + 1)]
        given.append(given[T].most(0.0))

        def body(number: Any, record: Record, alpha: Vector, held: Held) -> Held:
            """Return the channels of a block and its falling light behind a Gaussian."""
            del number
            left, *features, median, stop, light = held
            weight, after, is_lit = _take(alpha, light)
            values = [record[6 + k] for k in range(4)]
            return [
                is_lit.where(after, left),
                *[weight.times_plus(value, old) for old, value in zip(features, values, strict=True)],
                light.compare(">", 0.5).where(values[3], median),
                is_lit.where(record[PLACE], stop),
                after,
            ]

        left, *held, light = part.pass_members(given, body)
        for channel, vector in enumerate(held, RED):
            part.store(vector, channel)
        part.end(freeze(light, left, _SPENT), lit_blocks)
        return context.get_dummy_value()

    return signature, generate


@intrinsic
def weigh(typing_context, state, block, records, members, lit, sums):
    """Add the weights of Gaussians at the pixels of one block of a tile, and raise the largest; like `blend`.

    Args:
        typing_context: numba's, unused.
        state: (BLOCKS, CHANNELS, LANES) float32, of which T alone is used.
        block: Number of the block.
        records: (BATCH + 1, RECORD) float32; the last reaches nothing.
        members: int64, the records to weigh, as bits.
        lit: (1,) int64, blocks with light left; the bit is cleared if it is spent.
        sums: (BATCH + 1, 2, LANES) float32, changed in place: the largest and the sum of each record, lane by lane.
    """
    del typing_context
    signature = types.void(state, types.int64, records, types.int64, lit, sums)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Emit the code."""
        lit_blocks, totals = (context.make_array(sig.args[k])(context, builder, args[k]).data for k in (4, 5))
        part = Block(context, builder, sig, args)
        lanes = part.lanes

        def body(number: Any, record: Record, alpha: Vector, held: Held) -> Held:
            """Return the light behind a Gaussian, and add its weights."""
            del record
            weight, after, _ = _take(alpha, held[0])
            first, second = (place_of(builder, number, 2, k) for k in range(2))
            lanes.store(lanes.load(totals, first).most(weight), totals, first)
            lanes.store(lanes.load(totals, second) + weight, totals, second)
            return [after]

        (light,) = part.pass_members([part.load(T)], body)
        part.end(light.compare(">", _SPENT).where(light, 0.0), lit_blocks)
        return context.get_dummy_value()

    return signature, generate


@intrinsic
def take_weight(typing_context, sums, number):
    """Return the largest and the summed weight of a record, and set its lanes of `sums` to 0; see `weigh`."""
    del typing_context
    pair = types.UniTuple(types.float32, 2)
    signature = pair(sums, types.int64)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Emit the code."""
        lanes = Builder(builder, LANES, "float32")
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        places = [place_of(builder, args[1], 2, k) for k in range(2)]
        largest, total = (lanes.load(data, place) for place in places)
        for place in places:
            lanes.store(lanes.constant(0.0), data, place)
        return context.make_tuple(builder, pair, [largest.largest(), total.sum()])

    return signature, generate


@intrinsic
def gather(typing_context, state, block, records, members, lit, sums):
    """Add what the pixels of one block of a tile hold in RED, GREEN and BLUE, times the weights of Gaussians.

    Args:
        typing_context: numba's, unused.
        state: (BLOCKS, CHANNELS, LANES) float32; RED, GREEN and BLUE stay as they are.
        block: Number of the block.
        records: (BATCH + 1, RECORD) float32; the last reaches nothing.
        members: int64, the records to gather for, as bits.
        lit: (1,) int64, blocks with light left; the bit is cleared if it is spent.
        sums: (BATCH + 1, 3, LANES) float32, changed in place: the sums of each record, lane by lane.
    """
    del typing_context
    signature = types.void(state, types.int64, records, types.int64, lit, sums)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Emit the code."""
        lit_blocks, totals = (context.make_array(sig.args[k])(context, builder, args[k]).data for k in (4, 5))
        part = Block(context, builder, sig, args)
        lanes = part.lanes
        colors = [part.load(channel) for channel in (RED, GREEN, BLUE)]

        def body(number: Any, record: Record, alpha: Vector, held: Held) -> Held:
            """Return the light behind a Gaussian, and add its sums."""
            del record
            weight, after, _ = _take(alpha, held[0])
            for k, color in enumerate(colors):
                place = place_of(builder, number, 3, k)
                lanes.store(weight.times_plus(color, lanes.load(totals, place)), totals, place)
            return [after]

        (light,) = part.pass_members([part.load(T)], body)
        part.end(light.compare(">", _SPENT).where(light, 0.0), lit_blocks)
        return context.get_dummy_value()

    return signature, generate


@intrinsic
def take_sums(typing_context, sums, number, out, pair):
    """Write the three sums of a record and a zero into a row of out (P, 4), and set its lanes of `sums` to 0."""
    del typing_context
    signature = types.void(sums, types.int64, out, types.int64)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Emit the code."""
        lanes = Builder(builder, LANES, "float32")
        data, rows = (context.make_array(sig.args[k])(context, builder, args[k]).data for k in (0, 2))
        places = [place_of(builder, args[1], 3, k) for k in range(3)]
        totals = lanes.sums([lanes.load(data, place) for place in places])
        for place in places:
            lanes.store(lanes.constant(0.0), data, place)
        lanes.store_first(totals, 4, rows, builder.mul(args[3], as_int(4)))
        return context.get_dummy_value()

    return signature, generate
