"""What a tile and a Gaussian on it are as explicit vectors, and which blocks of the tile a Gaussian reaches.

A tile is 16 x 16 pixels: 4 x 4 blocks, row by row, of 4 x 4 pixels, one vector each. A round Gaussian touches fewer of
these than of rows of 16 pixels. The state of a tile is (BLOCKS, CHANNELS, LANES) float32. A Gaussian comes as a record
of 16 float32: `p(x, y) = c + lx x + ly y + A x^2 + B x y + C y^2` = log2 alpha over the tile's pixels x, y = 0..15,
which float32 knows well where a pixel sees the Gaussian, however far its center lies; then red, green, blue, depth;
then the center from the tile's first pixel. A pixel whose transmittance is spent holds it negated.

`forward` passes Gaussians through a block, front to back; `backward` takes one Gaussian out of a tile, back to front.
Records and blocks are computed for a batch of Gaussians before that: a predictor of branches cannot foresee the end of
a loop over blocks, so what follows it must not depend on long computations.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from gsvis._kernels.simd import Builder, Vector

__all__ = [
    "BATCH",
    "BLOCKS",
    "BLUE",
    "CENTER_X",
    "CENTER_Y",
    "CHANNELS",
    "DEPTH",
    "GREEN",
    "LANES",
    "LOG2_255",
    "MEDIAN",
    "PLACE",
    "RECORD",
    "RED",
    "SIDE",
    "STOP",
    "TILE",
    "Record",
    "T",
    "as_int",
    "block_of",
    "darken",
    "find_reached_blocks",
    "load_channel",
    "store_channel",
]

SIDE = 4  # pixels of a block along each side, and blocks of a tile
LANES = SIDE * SIDE
BLOCKS = SIDE * SIDE
TILE = SIDE * SIDE  # pixels of a tile along each side
BATCH = 64  # Gaussians prepared at a time
CHANNELS = 8
RECORD = 16
CENTER_X = 10
CENTER_Y = 11
"""Entries of a record: where the center is, from the tile's first pixel."""
PLACE = 12
"""Entry of a record: the place behind the Gaussian in the tile's list."""
T, RED, GREEN, BLUE, DEPTH, MEDIAN, STOP = range(7)
"""Forward state. Backward reads T and STOP, and holds in RED..DEPTH the gradients, in MEDIAN what lies behind.

STOP is the place, in the tile's list, behind the last Gaussian that found the pixel lit and left it lit.
"""

LOG2_255 = 7.994353436858858
"""A pixel sees a Gaussian where log2 alpha is at least the negative of this."""

_MARGIN = 1e-4  # log2 alpha; a surplus block costs little, a missing pixel shows
_F32 = ir.FloatType()
_I64 = ir.IntType(64)

_COLUMNS = [[SIDE * (block % SIDE) + lane % SIDE for lane in range(LANES)] for block in range(BLOCKS)]
_ROWS = [[SIDE * (block // SIDE) + lane // SIDE for lane in range(LANES)] for block in range(BLOCKS)]


def as_int(number: int) -> Any:
    """Return an int64 constant."""
    return ir.Constant(_I64, number)


class Record:
    """The record of one Gaussian, in the function under construction."""

    def __init__(self, context: Any, lanes: Builder, array_type: Any, array: Any, number: Any) -> None:
        self._lanes = lanes
        data = context.make_array(array_type)(context, lanes.ir, array).data
        self._first = lanes.ir.gep(data, [lanes.ir.mul(number, as_int(RECORD))])

    def scalar(self, k: int) -> Any:
        """Return entry k."""
        return self._lanes.ir.load(self._lanes.ir.gep(self._first, [as_int(k)]))

    def __getitem__(self, k: int) -> Vector:
        """Return entry k in all lanes."""
        return self._lanes.splat(self.scalar(k))


@intrinsic
def find_reached_blocks(typing_context, records, number, gates, place):
    """Return the blocks of a tile where alpha of the Gaussian reaches 1/255 and whose gate lies behind `place`.

    A block is reached if the square between the centers of its outer pixels is. Alpha is largest there on the edge that
    faces the center of the Gaussian, along x or along y, or at the center.

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
        left, right, top, bottom = (
            lanes.constants([numbers[lane] for numbers in rows[:BLOCKS]])
            for rows, lane in ((_COLUMNS, 0), (_COLUMNS, -1), (_ROWS, 0), (_ROWS, -1))
        )
        # A, C < 0: the dilation keeps every conic positive
        turn_x, turn_y = (lanes.splat(builder.fdiv(ir.Constant(_F32, -0.5), record.scalar(k))) for k in (3, 5))
        x = record[CENTER_X].most(left).least(right)
        slope = x.times_plus(record[4], record[2])
        y = (slope * turn_y).most(top).least(bottom)
        along = x.times_plus(record[3], record[1]).times_plus(x, record[0])
        at_x = record[5].times_plus(y, slope).times_plus(y, along)
        y = record[CENTER_Y].most(top).least(bottom)
        slope = y.times_plus(record[4], record[1])
        x = (slope * turn_x).most(left).least(right)
        along = y.times_plus(record[5], record[2]).times_plus(y, record[0])
        at_y = record[3].times_plus(x, slope).times_plus(x, along)
        most = at_x.most(at_y)
        is_open = lanes.load(gates, as_int(0)).compare(">", lanes.splat(args[3]))
        return (most.compare(">=", -LOG2_255 - _MARGIN) & is_open).bits()

    return signature, generate


def block_of(lanes: Builder, state: Any, block: Any) -> tuple[Any, Vector, Vector]:
    """Return the place of a block's state, and the columns and rows of its pixels in the tile."""
    here = lanes.ir.gep(state, [lanes.ir.mul(block, as_int(CHANNELS * LANES))])
    first = lanes.ir.mul(block, as_int(LANES))
    x, y = (lanes.load(lanes.table(name, rows), first) for name, rows in (("columns", _COLUMNS), ("rows", _ROWS)))
    return here, x, y


def load_channel(lanes: Builder, state: Any, channel: int) -> Vector:
    """Return the vector of a channel of a block."""
    return lanes.load(state, as_int(channel * LANES))


def store_channel(lanes: Builder, vector: Vector, state: Any, channel: int) -> None:
    """Store a vector as a channel of a block."""
    lanes.store(vector, state, as_int(channel * LANES))


def darken(lanes: Builder, block: Any, light: Vector, lit: Any) -> None:
    """Clear the bit of a block in `lit` if none of its pixels has light."""
    builder = lanes.ir
    with builder.if_then(builder.not_(light.compare(">", 0.0).any()), likely=False):
        builder.store(builder.and_(builder.load(lit), builder.not_(builder.shl(as_int(1), block))), lit)
