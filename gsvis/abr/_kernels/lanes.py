"""Test 64 spheres against a plane at once, for kernels: LLVM uses the SIMD lanes that the processor has."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

__all__ = ["not_behind"]

_LANES = 64


@intrinsic
def not_behind(typing_context: Any, x: Any, y: Any, z: Any, radii: Any, low: Any, plane: Any) -> Any:
    """Return which of 64 spheres reach the front of a plane, as bits: where a x + b y + c z + d + radius >= 0.

    Args:
        typing_context: Given by numba.
        x: (N,) float32 coordinates of centers, contiguous, N >= `low` + 64; scene units.
        y: (N,) float32 coordinates of centers.
        z: (N,) float32 coordinates of centers.
        radii: (N,) float32, scene units; a sphere with -inf is behind every plane.
        low: Index of the first of the 64 spheres.
        plane: (a, b, c, d) float32, with (a, b, c) a unit vector.

    Returns:
        uint64, bit i for sphere `low` + i. A sphere with a NaN reaches the front.
    """

    def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        """Build the LLVM code, with vectors of 64 floats."""
        lanes = ir.VectorType(ir.FloatType(), _LANES)
        first = ir.Constant(ir.IntType(32), 0)

        def load(k: int) -> Any:
            """Load 64 floats of array argument k, from `low` on."""
            data = context.make_array(signature.args[k])(context, builder, args[k]).data
            place = builder.bitcast(builder.gep(data, [args[4]]), lanes.as_pointer())
            return builder.load(place, align=4)

        def spread(k: int) -> Any:
            """Repeat coefficient k of the plane 64 times."""
            one = builder.insert_element(ir.Constant(lanes, ir.Undefined), builder.extract_value(args[5], k), first)
            every = ir.Constant(ir.VectorType(ir.IntType(32), _LANES), [0] * _LANES)
            return builder.shuffle_vector(one, ir.Constant(lanes, ir.Undefined), every)

        far = builder.fmul(spread(0), load(0))
        far = builder.fadd(far, builder.fmul(spread(1), load(1)))
        far = builder.fadd(far, builder.fmul(spread(2), load(2)))
        far = builder.fadd(builder.fadd(far, spread(3)), load(3))
        zero = ir.Constant(lanes, [0.0] * _LANES)
        return builder.bitcast(builder.fcmp_unordered(">=", far, zero), ir.IntType(64))

    return types.uint64(x, y, z, radii, types.int64, plane), build
