"""Take one Gaussian out of a tile, back to front, with or without its gradients."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from gsvis._kernels.simd import Builder, Vector, each_bit
from gsvis.render._kernels.lanes import (
    BLUE,
    CENTER_X,
    CENTER_Y,
    DEPTH,
    GREEN,
    LANES,
    LOG2_255,
    MEDIAN,
    RED,
    STOP,
    Record,
    T,
    as_int,
    block_of,
    load_channel,
    store_channel,
)

__all__ = ["blend_backward", "take_out"]


class _Pixels(NamedTuple):
    """The pixels of one block that a Gaussian reaches, one in each lane.

    Attributes:
        state: Place of the block's state.
        x: Column in the tile.
        y: Row in the tile.
        p: log2 alpha.
        seen: Mask of the lit pixels with alpha >= 1/255.
        t: Transmittance.
    """

    state: Any
    x: Vector
    y: Vector
    p: Vector
    seen: Vector
    t: Vector


def _find_power(record: Record, x: Vector, y: Vector) -> Vector:
    """Return log2 alpha of a Gaussian at pixels."""
    along = record[3].times_plus(x, record[1]).times_plus(x, record[0])
    across = record[4].times_plus(x, record[2])
    return record[5].times_plus(y, across).times_plus(y, along)


def _visit_blocks(lanes: Builder, state: Any, record: Record, todo: Any, body: Callable[[_Pixels], None]) -> None:
    """Call `body` for each block in `todo` in which a lit pixel sees the Gaussian."""

    def visit(block: Any) -> None:
        """Emit the code for one block."""
        here, x, y = block_of(lanes, state, block)
        t = load_channel(lanes, here, T)
        p = _find_power(record, x, y)
        seen = p.compare(">=", -LOG2_255) & t.compare(">", 0.0)
        with lanes.ir.if_then(seen.any(), likely=True):
            body(_Pixels(here, x, y, p, seen, t))

    each_bit(lanes.ir, todo, visit)


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


def _take_out_of_block(lanes: Builder, record: Record, place: Vector, pixels: _Pixels) -> _TakenOut:
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

        def body(pixels: _Pixels) -> None:
            """Emit the code for one block."""
            _take_out_of_block(lanes, record, place, pixels)

        _visit_blocks(lanes, data, record, args[3], body)
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
        center_x = record[CENTER_X]
        center_y = record[CENTER_Y]
        place = lanes.splat(args[4])
        rooms = [cgutils.alloca_once_value(builder, lanes.constant(0.0).value) for _ in range(10)]

        def add(k: int, value: Vector, factor: Vector | None = None) -> None:
            """Add a vector, times a factor if given, to sum k."""
            held = Vector(lanes, builder.load(rooms[k]))
            builder.store((held + value if factor is None else value.times_plus(factor, held)).value, rooms[k])

        def body(pixels: _Pixels) -> None:
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

        _visit_blocks(lanes, data, record, args[3], body)
        totals = lanes.sums([Vector(lanes, builder.load(room)) for room in rooms])
        lanes.store_first(totals, 12, totals_at, builder.mul(args[6], as_int(12)))
        return context.get_dummy_value()

    return signature, generate
