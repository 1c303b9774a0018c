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

from gsvis._kernels.simd import Builder, Vector
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
    without_lowest,
)

__all__ = ["blend", "gather", "list_by_block", "pass_members", "take_sums", "take_weight", "weigh"]

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


def pass_members(
    lanes: Builder,
    records: Callable[[Any], Record],
    members: Any,
    pixels: tuple[Vector, Vector],
    given: Held,
    body: Callable[[Any, Record, Vector, Held], Held],
    *,
    backward: bool = False,
) -> Held:
    """Emit a loop over the Gaussians of a block, and return the vectors that it ends with.

    Args:
        lanes: Vectors of the pixels of a block.
        records: Returns the record with a number.
        members: int64, the numbers of the Gaussians, as bits.
        pixels: Columns and rows of the pixels.
        given: The vectors to begin with.
        body: Returns the vectors behind one more Gaussian, from its number, its record, its alpha at the pixels, and
            the vectors in front. It is also called for records that reach nothing.
        backward: Take the Gaussians from the last to the first.
    """
    builder = lanes.ir
    before = builder.block
    head, inside, done = (builder.append_basic_block(name) for name in ("members", "some", "done"))
    builder.branch(head)
    builder.position_at_end(head)
    left = builder.phi(_I64)
    left.add_incoming(members, before)
    held = [Vector(lanes, builder.phi(lanes.type)) for _ in given]
    for vector, start in zip(held, given, strict=True):
        vector.value.add_incoming(start.value, before)
    builder.cbranch(builder.icmp_unsigned("!=", left, as_int(0)), inside, done)
    builder.position_at_end(inside)
    numbers = []
    rest = left
    for _ in range(TOGETHER):
        if backward:
            number, rest = _take_last(builder, rest)
        else:
            number = builder.cttz(rest, ir.Constant(ir.IntType(1), 0))  # BATCH, if none is left
            rest = without_lowest(builder, rest)
        numbers.append(number)
    some = [records(number) for number in numbers]
    behind = held
    for number, record, alpha in zip(numbers, some, _find_alphas(lanes, some, *pixels), strict=True):
        behind = body(number, record, alpha, behind)
    for vector, value in zip(held, behind, strict=True):
        vector.value.add_incoming(value.value, builder.block)
    left.add_incoming(rest, builder.block)
    builder.branch(head)
    builder.position_at_end(done)
    return held


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
        data, lit_blocks = (context.make_array(sig.args[k])(context, builder, args[k]).data for k in (0, 4))
        lanes = Builder(builder, LANES, "float32")
        here, x, y = block_of(lanes, data, args[1])
        records = partial(Record, context, lanes, sig.args[2], args[2])
        channels = range(STOP + 1)
        given = [load_channel(lanes, here, channel) for channel in channels]
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

        *held, light = pass_members(lanes, records, args[3], (x, y), given, body)
        held[T] = light.compare(">", _SPENT).where(held[T], held[T].most(held[T] * -1.0) * -1.0)
        for channel in channels:
            store_channel(lanes, held[channel], here, channel)
        darken(lanes, args[1], held[T], lit_blocks)
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
        data, lit_blocks, totals = (context.make_array(sig.args[k])(context, builder, args[k]).data for k in (0, 4, 5))
        lanes = Builder(builder, LANES, "float32")
        here, x, y = block_of(lanes, data, args[1])
        records = partial(Record, context, lanes, sig.args[2], args[2])

        def body(number: Any, record: Record, alpha: Vector, held: Held) -> Held:
            """Return the light behind a Gaussian, and add its weights."""
            del record
            weight, after, _ = _take(alpha, held[0])
            first = builder.mul(number, as_int(2 * LANES))
            second = builder.add(first, as_int(LANES))
            lanes.store(lanes.load(totals, first).most(weight), totals, first)
            lanes.store(lanes.load(totals, second) + weight, totals, second)
            return [after]

        (light,) = pass_members(lanes, records, args[3], (x, y), [load_channel(lanes, here, T)], body)
        light = light.compare(">", _SPENT).where(light, 0.0)
        store_channel(lanes, light, here, T)
        darken(lanes, args[1], light, lit_blocks)
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
        places = [builder.mul(args[1], as_int(2 * LANES))]
        places.append(builder.add(places[0], as_int(LANES)))
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
        data, lit_blocks, totals = (context.make_array(sig.args[k])(context, builder, args[k]).data for k in (0, 4, 5))
        lanes = Builder(builder, LANES, "float32")
        here, x, y = block_of(lanes, data, args[1])
        records = partial(Record, context, lanes, sig.args[2], args[2])
        colors = [load_channel(lanes, here, channel) for channel in (RED, GREEN, BLUE)]

        def body(number: Any, record: Record, alpha: Vector, held: Held) -> Held:
            """Return the light behind a Gaussian, and add its sums."""
            del record
            weight, after, _ = _take(alpha, held[0])
            for k, color in enumerate(colors):
                place = builder.add(builder.mul(number, as_int(3 * LANES)), as_int(k * LANES))
                lanes.store(weight.times_plus(color, lanes.load(totals, place)), totals, place)
            return [after]

        (light,) = pass_members(lanes, records, args[3], (x, y), [load_channel(lanes, here, T)], body)
        light = light.compare(">", _SPENT).where(light, 0.0)
        store_channel(lanes, light, here, T)
        darken(lanes, args[1], light, lit_blocks)
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
        places = [builder.add(builder.mul(args[1], as_int(3 * LANES)), as_int(k * LANES)) for k in range(3)]
        totals = lanes.sums([lanes.load(data, place) for place in places])
        for place in places:
            lanes.store(lanes.constant(0.0), data, place)
        lanes.store_first(totals, 4, rows, builder.mul(args[3], as_int(4)))
        return context.get_dummy_value()

    return signature, generate
