"""Blend Gaussians into blocks of 16 x 16 pixels, as explicit vectors: light, depths, largest weight.

A vector is two rows of eight pixels of a block, a band: a round Gaussian touches fewer of these than of rows of 16
pixels. log2 alpha is `p(x, y) = c + lx x + ly y + A x^2 + B x y + C y^2` over a block's pixels x, y = 0..15, which
float32 knows well where a pixel sees the Gaussian, however far its center lies.

Blocks are found for many Gaussians (`find_bands`) before they are blended (`blend_bands`): no processor foresees how
many bands a block has, so what follows must not wait for long computations.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from gsvis._kernels.simd import Builder, Vector, each_bit

__all__ = ["HEIGHT", "LANES", "RECORD", "STRIDE", "blend_bands", "find_bands", "rows_with_light", "take_largest"]

LANES = 16
WIDTH = 8
"""Columns of a band."""
STRIDE = 64 + LANES
"""Pixels from a row of a square to the next: the square's width, and room for a block that extends beyond it."""
HEIGHT = 64 + 2
"""Rows of a square: its own, and room for a band that extends beyond it."""
RECORD = 8
"""Numbers of the record of a Gaussian in a block: c, lx, ly, A, B, C, share of the weight that is taken, distance."""

_LOG2_255 = 7.994353436858858
_I16 = ir.IntType(16)
_I64 = ir.IntType(64)
_BANDS = 0x55555555  # the first row of each band, of the left and of the right half of a block


def _int(number: int) -> Any:
    return ir.Constant(_I64, number)


def _words(builder: Any, lit: Any, y: Any) -> Any:
    """Return a pointer to the light of the 16 rows from y on, as one vector of int64."""
    return builder.bitcast(builder.gep(lit, [y]), ir.VectorType(_I64, LANES).as_pointer())


def _same_words(builder: Any, word: Any) -> Any:
    """Return a vector with an int64 in all lanes."""
    nothing = ir.Constant(ir.VectorType(_I64, LANES), ir.Undefined)
    order = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
    return builder.shuffle_vector(builder.insert_element(nothing, word, _int(0)), nothing, order)


def _rows_with_light(builder: Any, words: Any, mask: Any) -> Any:
    """Return an int64, bit k set if row k has light in one of the pixels of a mask."""
    some = builder.and_(words, _same_words(builder, mask))
    found = builder.icmp_unsigned("!=", some, ir.Constant(words.type, [0] * LANES))
    return builder.zext(builder.bitcast(found, ir.IntType(LANES)), _I64)


@intrinsic
def rows_with_light(typing_context, lit, pixels, y):
    """Return a uint64, bit k set if row y + k has light in one of the pixels of a mask (uint64), for 16 rows."""
    del typing_context
    signature = types.uint64(lit, types.uint64, types.int64)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Emit the code."""
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        return _rows_with_light(builder, builder.load(_words(builder, data, args[2]), align=8), args[1])

    return signature, generate


@intrinsic
def find_bands(typing_context, lit, form, x, y, rows):
    """Find the bands of a block that have light and in which alpha reaches 1/255.

    Args:
        typing_context: The typing context of numba, unused.
        lit: (64 + 16,) uint64, for each row bit x set if pixel x has light left.
        form: Six float32: c, lx, ly, A, B, C of log2 alpha from the block's first pixel.
        x: First column of the block in the square.
        y: First row of the block in the square.
        rows: Number of rows of the block, 1 to 16.

    Returns:
        int64, of the bits 0 to 15 those of the first rows of bands of the left half, then those of the right half.
    """
    del typing_context
    i64 = types.int64
    signature = i64(lit, types.UniTuple(types.float32, 6), i64, i64, i64)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Emit the code."""
        lanes = Builder(builder, LANES, "float32")
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        words = builder.load(_words(builder, data, args[3]), align=8)
        c, lx, ly, a, b, square = (lanes.splat(entry) for entry in cgutils.unpack_tuple(builder, args[1], 6))
        y = lanes.counting()
        slope = y.times_plus(b, lx)
        level = y.times_plus(square, ly).times_plus(y, c)
        # A < 0: the dilation keeps every conic positive
        turn = slope * (lanes.constant(-0.5) / a)
        below = builder.sub(builder.shl(_int(1), args[4]), _int(1))
        found = _int(0)
        for half, first in enumerate((0, WIDTH)):
            peak = turn.most(float(first)).least(first + WIDTH - 1.0)
            reached = a.times_plus(peak, slope).times_plus(peak, level).compare(">=", -_LOG2_255).bits()
            pixels = builder.shl(_int((2**WIDTH - 1) << first), args[2])
            some = builder.and_(builder.and_(reached, _rows_with_light(builder, words, pixels)), below)
            found = builder.or_(found, builder.shl(some, _int(LANES * half)))
        return builder.and_(builder.or_(found, builder.lshr(found, _int(1))), _int(_BANDS))

    return signature, generate


class _Rows:
    """The two rows of a band of a square."""

    def __init__(self, lanes: Builder, data: Any) -> None:
        self._lanes = lanes
        self._data = data
        self._half = Builder(lanes.ir, WIDTH, "float32")

    def load(self, offset: Any) -> Vector:
        """Return the pixels of a band that begins at an offset."""
        ends = (offset, self._lanes.ir.add(offset, _int(STRIDE)))
        first, second = (self._half.load(self._data, each).value for each in ends)
        order = ir.Constant(ir.VectorType(ir.IntType(32), LANES), list(range(LANES)))
        return Vector(self._lanes, self._lanes.ir.shuffle_vector(first, second, order))

    def store(self, vector: Vector, offset: Any) -> None:
        """Write the pixels of a band."""
        builder = self._lanes.ir
        for k, end in enumerate((offset, builder.add(offset, _int(STRIDE)))):
            order = ir.Constant(ir.VectorType(ir.IntType(32), WIDTH), [WIDTH * k + j for j in range(WIDTH)])
            part = builder.shuffle_vector(vector.value, vector.value, order)
            self._half.store(Vector(self._half, part), self._data, end)


class _Block:
    """A block of a square in the function under construction; bands are numbered as in `find_bands`."""

    def __init__(self, builder: Any, square: Any, lit: Any, x: Any, y: Any) -> None:
        self.ir = builder
        self.rows = _Rows(Builder(builder, LANES, "float32"), square)
        self._lit = lit
        self._x = x
        self._y = y
        self._spent = cgutils.alloca_once(builder, ir.ArrayType(_I16, LANES))  # pixels of each band that became spent
        nothing = ir.VectorType(_I16, LANES)
        builder.store(ir.Constant(nothing, [0] * LANES), builder.bitcast(self._spent, nothing.as_pointer()), align=2)

    def offset_of(self, band: Any) -> Any:
        """Return where the pixels of a band begin."""
        builder = self.ir
        row = builder.add(self._y, builder.and_(band, _int(LANES - 1)))
        column = builder.add(self._x, builder.lshr(builder.and_(band, _int(LANES)), _int(1)))
        return builder.add(builder.mul(row, _int(STRIDE)), column)

    def _bits(self, band: Any) -> Any:
        return self.ir.gep(self._spent, [_int(0), self.ir.lshr(band, _int(1))])

    def end(self, band: Any, crossed: Vector) -> None:
        """Record which pixels of a band became spent."""
        self.ir.store(self.ir.bitcast(crossed.value, _I16), self._bits(band))

    def darken(self) -> Any:
        """Take the light from the words of the rows for pixels that became spent; return their number."""
        builder = self.ir
        gone = ir.Constant(ir.VectorType(_I64, LANES), [0] * LANES)
        count = _int(0)
        octets = ir.VectorType(ir.IntType(8), LANES)
        place = builder.bitcast(self._spent, octets.as_pointer())
        for half in range(2):
            # The two bytes of a band are its two rows, so bytes are rows.
            bytes_of_rows = builder.load(builder.gep(place, [_int(half)]), align=2)
            shift = _same_words(builder, builder.add(self._x, _int(WIDTH * half)))
            gone = builder.or_(gone, builder.shl(builder.zext(bytes_of_rows, gone.type), shift))
            number = builder.ctpop(builder.bitcast(bytes_of_rows, ir.IntType(128)))
            count = builder.add(count, builder.trunc(number, _I64))
        words = _words(builder, self._lit, self._y)
        builder.store(builder.and_(builder.load(words, align=8), builder.not_(gone)), words, align=8)
        return count

    def set_depths(self, bands: Any, far: Vector) -> None:
        """Write the distance of pixels that became spent."""

        def emit(band: Any) -> None:
            """Write those of one band."""
            builder = self.ir
            bits = builder.load(self._bits(band))
            crossed = Vector(far.home, builder.bitcast(bits, ir.VectorType(ir.IntType(1), LANES)))
            offset = builder.add(self.offset_of(band), _int(HEIGHT * STRIDE))
            self.rows.store(crossed.where(far, self.rows.load(offset)), offset)

        each_bit(self.ir, bands, emit)


@intrinsic
def blend_bands(typing_context, square, lit, records, number, bands, x, y, spent, most, place, deep):
    """Blend a Gaussian into the bands of a block of a square of pixels.

    Args:
        typing_context: The typing context of numba, unused.
        square: (2, HEIGHT, STRIDE) float32, changed in place: transmittance, and the distance at which it is spent.
        lit: (64 + 16,) uint64, changed in place: for each row, bit x set if pixel x has light left.
        records: (RECORD * K,) float32.
        number: Number of the record of the Gaussian in this block.
        bands: Its bands, from `find_bands`.
        x: First column of the block in the square.
        y: First row of the block in the square.
        spent: Transmittance below which a pixel is spent.
        most: (32 * K,) float32, changed in place: for each Gaussian largest weight and largest light, lane by lane.
            Spent pixels are skipped.
        place: Number of the Gaussian in `most`.
        deep: Whether distances are written.

    Returns:
        int64, number of pixels that became spent.
    """
    del typing_context
    i64 = types.int64
    signature = i64(square, lit, records, i64, i64, i64, i64, types.float32, most, i64, types.boolean)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Emit the code."""
        lanes = Builder(builder, LANES, "float32")
        data, words, records, largest = (
            context.make_array(sig.args[k])(context, builder, args[k]).data for k in (0, 1, 2, 8)
        )
        block = _Block(builder, data, words, args[5], args[6])
        first = builder.mul(args[3], _int(RECORD))
        c, lx, ly, a, b, quadratic, cover, far = (
            lanes.splat(builder.load(builder.gep(records, [builder.add(first, _int(k))]))) for k in range(RECORD)
        )
        limit = lanes.splat(args[7])
        halves = cgutils.alloca_once(builder, ir.ArrayType(ir.FloatType(), 4 * LANES))
        halves = builder.bitcast(halves, ir.FloatType().as_pointer())
        for half in range(2):
            k = lanes.constants([WIDTH * half + lane % WIDTH for lane in range(LANES)])
            lanes.store(a.times_plus(k, lx).times_plus(k, c), halves, _int(2 * LANES * half))
            lanes.store(b.times_plus(k, ly), halves, _int((2 * half + 1) * LANES))
        rows = lanes.table(
            ".rows_of_bands", [[row + lane // WIDTH for lane in range(LANES)] for row in range(0, 16, 2)]
        )
        at = builder.mul(args[9], _int(2 * LANES))
        ends = (at, builder.add(at, _int(LANES)))
        room = [cgutils.alloca_once_value(builder, lanes.load(largest, end).value) for end in ends]
        any_spent = cgutils.alloca_once_value(builder, ir.Constant(_I16, 0))

        def emit(band: Any) -> None:
            """Blend into one band."""
            offset = block.offset_of(band)
            y = lanes.load(rows, builder.mul(builder.and_(band, _int(LANES - 1)), _int(LANES // 2)))
            half = builder.mul(builder.and_(band, _int(LANES)), _int(2))
            along = lanes.load(halves, half)
            across = lanes.load(halves, builder.add(half, _int(LANES)))
            p = quadratic.times_plus(y, across).times_plus(y, along)
            before = block.rows.load(offset)
            seen = p.compare(">=", -_LOG2_255) & before.compare(">=", limit)
            weight = seen.where(p.exp2().least(0.999), 0.0) * before
            after = before - weight * cover
            block.rows.store(after, offset)
            for place, vector in zip(room, (weight, seen.where(before, 0.0)), strict=True):
                builder.store(Vector(lanes, builder.load(place)).most(vector).value, place)
            crossed = seen & after.compare("<", limit)
            block.end(band, crossed)
            builder.store(builder.or_(builder.load(any_spent), builder.bitcast(crossed.value, _I16)), any_spent)

        each_bit(builder, args[4], emit)
        for place, end in zip(room, ends, strict=True):
            lanes.store(Vector(lanes, builder.load(place)), largest, end)
        darkened = cgutils.alloca_once_value(builder, _int(0))
        with builder.if_then(builder.icmp_unsigned("!=", builder.load(any_spent), ir.Constant(_I16, 0))):
            builder.store(block.darken(), darkened)
            with builder.if_then(args[10]):
                block.set_depths(args[4], far)
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
