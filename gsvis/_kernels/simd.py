"""Explicit SIMD vectors inside numba kernels: a thin layer over LLVM's fixed-width vector types.

numba does not vectorize the short loops with branches over rays and tiles, so the innermost code is written with
vectors of a fixed width. LLVM compiles them to what the machine has (AVX-512, AVX2, SSE, NEON). A `Vector` is a value
in the function that is being built, not an array: operators append instructions to the function.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from llvmlite import ir
from numba.core import cgutils

__all__ = ["Builder", "Vector", "each_bit", "loop_over_bits", "without_lowest"]

_I32 = ir.IntType(32)
_I64 = ir.IntType(64)
_EXP2 = (1.0, 0.6931471806, 0.2402265079, 0.0555041086, 0.0096181292, 0.0013333558, 0.00015403530)
"""Taylor coefficients of 2^x, of degree 6; on [-1/2, 1/2] their error is below one float32 ulp."""


class Vector:
    """A SIMD vector with arithmetic and comparison; a comparison gives a mask."""

    def __init__(self, home: Builder, value: Any) -> None:
        self.home = home
        self.value = value

    def _pair(self, other: Vector | float) -> tuple[Any, Any]:
        """Return the LLVM values of both operands."""
        return self.value, (other if isinstance(other, Vector) else self.home.constant(other)).value

    def __add__(self, other: Vector | float) -> Vector:
        return Vector(self.home, self.home.ir.fadd(*self._pair(other)))

    def __sub__(self, other: Vector | float) -> Vector:
        return Vector(self.home, self.home.ir.fsub(*self._pair(other)))

    def __mul__(self, other: Vector | float) -> Vector:
        return Vector(self.home, self.home.ir.fmul(*self._pair(other)))

    def __truediv__(self, other: Vector | float) -> Vector:
        return Vector(self.home, self.home.ir.fdiv(*self._pair(other)))

    def __and__(self, other: Vector) -> Vector:
        return Vector(self.home, self.home.ir.and_(self.value, other.value))

    def compare(self, how: str, other: Vector | float) -> Vector:
        """Return a mask: lanes where `self <how> other` is true; false for NaN."""
        return Vector(self.home, self.home.ir.fcmp_ordered(how, *self._pair(other)))

    def where(self, yes: Vector | float, no: Vector | float) -> Vector:
        """Return `yes` in the lanes where this mask is set, else `no`."""
        a = yes if isinstance(yes, Vector) else self.home.constant(yes)
        b = no if isinstance(no, Vector) else self.home.constant(no)
        return Vector(self.home, self.home.ir.select(self.value, a.value, b.value))

    def least(self, other: Vector | float) -> Vector:
        """Return the smaller value of each lane."""
        return self.compare("<", other).where(self, other)

    def most(self, other: Vector | float) -> Vector:
        """Return the larger value of each lane."""
        return self.compare(">", other).where(self, other)

    def times_plus(self, factor: Vector | float, addend: Vector | float) -> Vector:
        """Return `self * factor + addend`, rounded once."""
        b, c = (v if isinstance(v, Vector) else self.home.constant(v) for v in (factor, addend))
        return self.home.call("llvm.fma", self, b, c)

    def exp2(self, *, bounded: bool = True) -> Vector:
        """Return 2^self of float32 lanes up to 126, within about one ulp.

        Lanes below -126 give 2^-126, or anything if not `bounded`, for callers that select others.
        """
        home = self.home
        power = self.most(-126.0) if bounded else self
        whole = home.call("llvm.nearbyint", power)
        part = power - whole
        # Estrin's scheme: powers in parallel, because Horner's chain of operations would be slower.
        square = part * part
        c0, c1, c2, c3, c4, c5, c6 = _EXP2
        low = part.times_plus(c1, c0) + square * part.times_plus(c3, c2)
        high = part.times_plus(c5, c4) + square * c6
        result = (square * square).times_plus(high, low)
        integers = ir.VectorType(_I32, home.lanes)
        exponent = home.ir.shl(home.ir.fptosi(whole.value, integers), home.splat_int(23))
        bits = home.ir.add(home.ir.bitcast(result.value, integers), exponent)
        return Vector(home, home.ir.bitcast(bits, home.type))

    def any(self) -> Any:
        """Return one bit: whether any lane of this mask is set."""
        bits = self.home.ir.bitcast(self.value, ir.IntType(self.home.lanes))
        return self.home.ir.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))

    def bits(self) -> Any:
        """Return the lanes of this mask as bits of an int64, lane 0 lowest."""
        return self.home.ir.zext(self.home.ir.bitcast(self.value, ir.IntType(self.home.lanes)), ir.IntType(64))

    def sum(self) -> Any:
        """Return the sum of the lanes as a scalar, always in the same order."""
        return self._reduce(lambda a, b: a + b)

    def largest(self) -> Any:
        """Return the largest lane as a scalar."""
        return self._reduce(lambda a, b: a.most(b))

    def _reduce(self, join: Any) -> Any:
        """Return all lanes joined to a scalar, by halves: `join` takes two vectors."""
        home = self.home
        value = self
        lanes = self.home.lanes
        while lanes > 1:
            lanes //= 2
            swap = [i ^ lanes for i in range(home.lanes)]
            mask = ir.Constant(ir.VectorType(_I32, home.lanes), swap)
            value = join(value, Vector(home, home.ir.shuffle_vector(value.value, value.value, mask)))
        return home.ir.extract_element(value.value, ir.Constant(_I32, 0))


class Builder:
    """Makes vectors of `lanes` lanes of `element` ("float32" or "float64") in the function that `builder` builds."""

    def __init__(self, builder: Any, lanes: int, element: str) -> None:
        self.ir = builder
        self.lanes = lanes
        self.element = ir.FloatType() if element == "float32" else ir.DoubleType()
        self.type = ir.VectorType(self.element, lanes)

    def constant(self, number: float) -> Vector:
        """Return a vector with the same number in all lanes."""
        return Vector(self, ir.Constant(self.type, [number] * self.lanes))

    def counting(self) -> Vector:
        """Return the vector 0, 1, 2, ..."""
        return Vector(self, ir.Constant(self.type, [float(k) for k in range(self.lanes)]))

    def constants(self, numbers: Sequence[float]) -> Vector:
        """Return a vector with these numbers in its lanes."""
        return Vector(self, ir.Constant(self.type, [float(number) for number in numbers]))

    def table(self, name: str, vectors: Sequence[Sequence[float]]) -> Any:
        """Return a pointer to constant vectors, one behind the other."""
        numbers = [float(number) for vector in vectors for number in vector]
        kind = ir.ArrayType(self.element, len(numbers))
        place = cgutils.global_constant(self.ir, name, ir.Constant(kind, numbers))
        place.align = self.lanes * 4
        return self.ir.bitcast(place, self.element.as_pointer())

    def splat_int(self, number: int) -> Any:
        """Return an LLVM constant with the same int32 in all lanes."""
        return ir.Constant(ir.VectorType(_I32, self.lanes), [number] * self.lanes)

    def splat(self, scalar: Any) -> Vector:
        """Return a vector with a scalar of the element type in all lanes."""
        nothing = ir.Constant(self.type, ir.Undefined)
        single = self.ir.insert_element(nothing, scalar, ir.Constant(_I32, 0))
        return Vector(self, self.ir.shuffle_vector(single, nothing, self.splat_int(0)))

    def join(self, vectors: Sequence[Vector]) -> Vector:
        """Return one vector with the lanes of several, whose number is a power of two."""
        values = [vector.value for vector in vectors]
        lanes = self.lanes // len(values)
        while len(values) > 1:
            lanes *= 2
            kind = ir.Constant(ir.VectorType(_I32, lanes), list(range(lanes)))
            values = [self.ir.shuffle_vector(a, b, kind) for a, b in zip(values[::2], values[1::2], strict=True)]
        return Vector(self, values[0])

    def parts(self, vector: Vector) -> list[Vector]:
        """Return the vectors of `lanes` lanes that one of `join` consists of."""
        starts = range(0, vector.home.lanes, self.lanes)
        masks = [ir.Constant(ir.VectorType(_I32, self.lanes), list(range(k, k + self.lanes))) for k in starts]
        return [Vector(self, self.ir.shuffle_vector(vector.value, vector.value, mask)) for mask in masks]

    def call(self, name: str, *arguments: Vector) -> Vector:
        """Call an LLVM intrinsic with vectors, such as llvm.nearbyint, and return its result."""
        kind = ir.FunctionType(self.type, [self.type] * len(arguments))
        suffix = f"v{self.lanes}f{32 if self.element == ir.FloatType() else 64}"
        function = self.ir.module.globals.get(f"{name}.{suffix}")
        if function is None:
            function = ir.Function(self.ir.module, kind, f"{name}.{suffix}")
        return Vector(self, self.ir.call(function, [a.value for a in arguments]))

    def load(self, pointer: Any, offset: Any, element: str | None = None) -> Vector:
        """Load `lanes` elements from `pointer + offset` on; with `element` "float32", convert them to this type."""
        kind = ir.FloatType() if element == "float32" else self.element
        address = self.ir.bitcast(self.ir.gep(pointer, [offset]), ir.VectorType(kind, self.lanes).as_pointer())
        value = self.ir.load(address, align=4)
        return Vector(self, value if kind == self.element else self.ir.fpext(value, self.type))

    def store(self, vector: Vector, pointer: Any, offset: Any) -> None:
        """Write the lanes to `pointer + offset`."""
        address = self.ir.bitcast(self.ir.gep(pointer, [offset]), self.type.as_pointer())
        self.ir.store(vector.value, address, align=4)

    def store_first(self, vector: Vector, count: int, pointer: Any, offset: Any) -> None:
        """Write the first `count` lanes, a multiple of four, to `pointer + offset`."""
        for first in range(0, count, 4):
            mask = ir.Constant(ir.VectorType(_I32, 4), list(range(first, first + 4)))
            part = self.ir.shuffle_vector(vector.value, vector.value, mask)
            place = self.ir.gep(pointer, [self.ir.add(offset, ir.Constant(ir.IntType(64), first))])
            self.ir.store(part, self.ir.bitcast(place, ir.VectorType(self.element, 4).as_pointer()), align=4)

    def sums(self, vectors: list[Vector]) -> Vector:
        """Return the sums of the lanes of up to `lanes` vectors; sum k is in lane k.

        Pairs of vectors are added into one, half by half, which is five times faster than summing each vector.
        """
        zero = self.constant(0.0)
        row = [*vectors, *[zero] * (self.lanes - len(vectors))]
        step = self.lanes // 2
        while step:
            row = [
                self._add_halves(a, b, step) if a is not zero else zero
                for a, b in zip(row[::2], row[1::2], strict=True)
            ]
            step //= 2
        # Lane l now has the sum whose number is l with its bits reversed.
        bits = self.lanes.bit_length() - 1
        mask = [int(f"{k:0{bits}b}"[::-1], 2) for k in range(self.lanes)]
        shuffle = ir.Constant(ir.VectorType(_I32, self.lanes), mask)
        return Vector(self, self.ir.shuffle_vector(row[0].value, row[0].value, shuffle))

    def _add_halves(self, a: Vector, b: Vector, step: int) -> Vector:
        """Return a[l] + a[l ^ step] in lanes l without the bit `step`, and b[l] + b[l ^ step] in the others."""
        kind = ir.VectorType(_I32, self.lanes)
        own = ir.Constant(kind, [k + (self.lanes if k & step else 0) for k in range(self.lanes)])
        other = ir.Constant(kind, [(k ^ step) + (self.lanes if k & step else 0) for k in range(self.lanes)])
        shuffled = [Vector(self, self.ir.shuffle_vector(a.value, b.value, mask)) for mask in (own, other)]
        return shuffled[0] + shuffled[1]


def loop_over_bits(
    builder: Any, bits: Any, given: list[Vector], body: Callable[[Any, list[Vector]], tuple[Any, list[Vector]]]
) -> list[Vector]:
    """Emit a loop that ends when no bit is left, and return the vectors that it ends with.

    Args:
        builder: The builder of the function.
        bits: int64.
        given: The vectors to begin with, kept in registers.
        body: Returns the bits that are left after a turn, and the vectors, from those before it.
    """
    before = builder.block
    head, inside, done = (builder.append_basic_block(name) for name in ("bits", "turn", "bits_done"))
    builder.branch(head)
    builder.position_at_end(head)
    left = builder.phi(_I64)
    left.add_incoming(bits, before)
    held = [Vector(vector.home, builder.phi(vector.home.type)) for vector in given]
    for vector, start in zip(held, given, strict=True):
        vector.value.add_incoming(start.value, before)
    builder.cbranch(builder.icmp_unsigned("!=", left, ir.Constant(_I64, 0)), inside, done)
    builder.position_at_end(inside)
    rest, behind = body(left, held)
    left.add_incoming(rest, builder.block)
    for vector, value in zip(held, behind, strict=True):
        vector.value.add_incoming(value.value, builder.block)
    builder.branch(head)
    builder.position_at_end(done)
    return held


def each_bit(builder: Any, bits: Any, emit: Callable[[Any], None]) -> None:
    """Emit a loop with the number of each bit of an int64, from the lowest on."""

    def body(left: Any, held: list[Vector]) -> tuple[Any, list[Vector]]:
        """Emit one turn."""
        emit(builder.cttz(left, ir.Constant(ir.IntType(1), 1)))
        return without_lowest(builder, left), held

    loop_over_bits(builder, bits, [], body)


def without_lowest(builder: Any, bits: Any) -> Any:
    """Return an int64 but for the lowest bit that is set."""
    return builder.and_(bits, builder.sub(bits, ir.Constant(_I64, 1)))
