"""Test a ray against eight boxes with explicit vectors; the loop form is not vectorized reliably.

`tests/raycast/test_kernels.py` compares it with the loop. World frame, scene units.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from gsvis._kernels.simd import Builder

__all__ = ["meets_eight"]


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
