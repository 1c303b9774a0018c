"""One plane against the 64 spheres of a word at once, for kernels: LLVM makes of it whatever lanes a processor has."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

__all__ = ["not_behind"]

_LANES = 64


@intrinsic
def not_behind(typing_context: Any, x: Any, y: Any, z: Any, radii: Any, low: Any, plane: Any) -> Any:
    """Return as bits which of 64 spheres from `low` on reach the front of a plane, as a x + b y + c z + d + r >= 0.

    Args:
        typing_context: Given by numba.
        x: (N,) float32 centers, contiguous, N >= `low` + 64; scene units, as are the others.
        y: (N,) float32.
        z: (N,) float32.
        radii: (N,) float32; -inf is behind every plane.
        low: First of the spheres.
        plane: (a, b, c, d) float32, with (a, b, c) a unit vector.

    Returns:
        uint64, bit i for sphere `low` + i. A sphere that is not a number reaches the front.
    """

    def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        lanes = ir.VectorType(ir.FloatType(), _LANES)
        flag = ir.Constant(ir.IntType(32), 0)

        def load(k: int) -> Any:
            data = context.make_array(signature.args[k])(context, builder, args[k]).data
            place = builder.bitcast(builder.gep(data, [args[4]]), lanes.as_pointer())
            return builder.load(place, align=4)

        def spread(k: int) -> Any:
            one = builder.insert_element(ir.Constant(lanes, ir.Undefined), builder.extract_value(args[5], k), flag)
            every = ir.Constant(ir.VectorType(ir.IntType(32), _LANES), [0] * _LANES)
            return builder.shuffle_vector(one, ir.Constant(lanes, ir.Undefined), every)

        far = builder.fmul(spread(0), load(0))
        far = builder.fadd(far, builder.fmul(spread(1), load(1)))
        far = builder.fadd(far, builder.fmul(spread(2), load(2)))
        far = builder.fadd(builder.fadd(far, spread(3)), load(3))
        zero = ir.Constant(lanes, [0.0] * _LANES)
        return builder.bitcast(builder.fcmp_unordered(">=", far, zero), ir.IntType(64))

    return types.uint64(x, y, z, radii, types.int64, plane), build
