"""Meet a ray with eight boxes or eight Gaussians at once, with explicit vectors; loops are not vectorized reliably.

`tests/raycast/test_kernels.py` compares both with the loops they stand for. World frame, scene units.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from gsvis._kernels.simd import Builder, Vector

__all__ = ["EIGHT", "meets_eight", "peaks_of_eight"]

EIGHT = 8
_ROW = 16  # float32 of a Gaussian
_I32 = ir.IntType(32)
_I64 = ir.IntType(64)


@intrinsic
def meets_eight(typing_context, boxes, node, origin, inverse, t_stop, t_near):
    """Test a ray (slab test) against the eight child boxes of a node.

    Args:
        typing_context: The typing context of numba, unused.
        boxes: (M, 6, 8) float32 lowest x y z, highest x y z; empty children have +inf in all six.
        node: Index into `boxes`.
        origin: Tuple of three float64.
        inverse: Tuple of three float64, 1 / direction, finite.
        t_stop: float64; boxes entered beyond it are not hit.
        t_near: (8,) float64, receives the entry depths (>= 0), valid where the bit is set.

    Returns:
        int64 with bit k set if the ray meets box k.
    """
    del typing_context
    triple = types.UniTuple(types.float64, 3)
    signature = types.int64(boxes, types.int64, triple, triple, types.float64, t_near)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Emit the code."""
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        out = context.make_array(sig.args[5])(context, builder, args[5]).data
        lanes = Builder(builder, 8, "float64")
        first = builder.mul(args[1], ir.Constant(ir.IntType(64), 48))
        near = lanes.constant(0.0)
        far = lanes.splat(args[4])
        for axis in range(3):
            o = lanes.splat(builder.extract_value(args[2], axis))
            i = lanes.splat(builder.extract_value(args[3], axis))
            low = builder.add(first, ir.Constant(ir.IntType(64), 8 * axis))
            high = builder.add(first, ir.Constant(ir.IntType(64), 8 * (3 + axis)))
            a = (lanes.load(data, low, "float32") - o) * i
            b = (lanes.load(data, high, "float32") - o) * i
            near = near.most(a.least(b))
            far = far.least(a.most(b))
        lanes.store(near, out, ir.Constant(ir.IntType(64), 0))
        return (near.compare("<=", far) & near.compare("<", float("inf"))).bits()

    return signature, generate


@intrinsic
def peaks_of_eight(typing_context, table, queue, first, origin, direction, squares, depths):
    """Find where a line comes nearest to eight Gaussians, as `peak_of` of `trace.py` does for one, with the same bits.

    Args:
        typing_context: The typing context of numba, unused.
        table: (M, 16) float32, as in `trace.py`.
        queue: int64, the positions of the Gaussians one behind the other, among others.
        first: Index into `queue`.
        origin: Tuple of three float64.
        direction: Tuple of three float64.
        squares: (8,) float64, receives the least squared distances on the ray, in standard deviations.
        depths: (8,) float64, receives where the line's response is largest.

    Returns:
        int64 with bit k set unless the ray passes Gaussian k beyond its reach.
    """
    del typing_context
    triple = types.UniTuple(types.float64, 3)
    signature = types.int64(table, queue, types.int64, triple, triple, squares, depths)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Emit the code."""
        arrays = [context.make_array(sig.args[k])(context, builder, args[k]).data for k in (0, 1, 5, 6)]
        rows, positions, out_squares, out_depths = arrays
        lanes = Builder(builder, EIGHT, "float64")
        columns = _load_columns(builder, rows, positions, args[2])
        o = [lanes.splat(builder.extract_value(args[3], axis)) for axis in range(3)]
        d = [lanes.splat(builder.extract_value(args[4], axis)) for axis in range(3)]
        square, depth = _peaks(lanes, columns, o, d)
        zero = ir.Constant(_I64, 0)
        lanes.store(square, out_squares, zero)
        lanes.store(depth, out_depths, zero)
        beyond = square.compare(">", columns[10])
        return builder.xor(beyond.bits(), ir.Constant(_I64, 2**EIGHT - 1))

    return signature, generate


def _load_columns(builder: Any, rows: Any, positions: Any, first: Any) -> list[Vector]:
    """Return the 16 columns of eight rows as float64."""
    narrow = Builder(builder, EIGHT, "float32")
    wide = Builder(builder, EIGHT, "float64")
    found = []
    starts = []
    for k in range(EIGHT):
        position = builder.load(builder.gep(positions, [builder.add(first, ir.Constant(_I64, k))]))
        starts.append(builder.mul(position, ir.Constant(_I64, _ROW)))
    for half in range(0, _ROW, EIGHT):
        loaded = [narrow.load(rows, builder.add(start, ir.Constant(_I64, half))) for start in starts]
        found += [Vector(wide, builder.fpext(each.value, wide.type)) for each in _transposed(builder, loaded)]
    return found


def _transposed(builder: Any, rows: list[Vector]) -> list[Vector]:
    """Return the columns of a square matrix of vectors, in three steps that exchange blocks of 4, 2 and 1 lanes."""
    size = len(rows)
    step = size // 2
    while step:
        exchanged = list(rows)
        for k in range(size):
            if k & step:
                continue
            upper = rows[k]
            lower = rows[k + step]
            left = [lane if not lane & step else size + lane - step for lane in range(size)]
            right = [lane + step if not lane & step else size + lane for lane in range(size)]
            for place, lanes in ((k, left), (k + step, right)):
                mask = ir.Constant(ir.VectorType(_I32, size), lanes)
                exchanged[place] = Vector(upper.home, builder.shuffle_vector(upper.value, lower.value, mask))
        rows = exchanged
        step //= 2
    return rows


def _peaks(lanes: Builder, columns: list[Vector], o: list[Vector], d: list[Vector]) -> tuple[Vector, Vector]:
    """Return the least squared distances and the places of the largest response, of eight Gaussians."""
    x, y, z = (o[axis] - columns[axis] for axis in range(3))
    w, i, j, k = columns[3:7]
    inverse = [columns[7 + axis] + columns[13 + axis] for axis in range(3)]
    one = lanes.constant(1.0)
    axes = (
        (one - (j * j + k * k) * 2.0, (i * j + w * k) * 2.0, (i * k - w * j) * 2.0),
        ((i * j - w * k) * 2.0, one - (i * i + k * k) * 2.0, (j * k + w * i) * 2.0),
        ((i * k + w * j) * 2.0, (j * k - w * i) * 2.0, one - (i * i + j * j) * 2.0),
    )
    p = [(a * x + b * y + c * z) * scale for (a, b, c), scale in zip(axes, inverse, strict=True)]
    q = [(a * d[0] + b * d[1] + c * d[2]) * scale for (a, b, c), scale in zip(axes, inverse, strict=True)]
    along = p[0] * q[0] + p[1] * q[1] + p[2] * q[2]
    length = q[0] * q[0] + q[1] * q[1] + q[2] * q[2]
    cross = (p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0])
    aside = (cross[0] * cross[0] + cross[1] * cross[1] + cross[2] * cross[2]) / length
    at_origin = p[0] * p[0] + p[1] * p[1] + p[2] * p[2]
    negated = Vector(lanes, lanes.ir.fneg(along.value))
    return along.compare(">=", 0.0).where(at_origin, aside), negated / length
