"""The ray-box test of eight boxes as explicit LLVM vectors, because the loop form is not vectorised reliably.

LLVM lowers the eight-wide vectors to whatever the machine has (AVX-512, AVX2, SSE, NEON), so this is portable.
`tests/raycast/test_kernels.py` compares it with the loop it stands for.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

__all__ = ["meets_eight"]


@intrinsic
def meets_eight(typing_context, boxes, node, origin, inverse, t_stop, t_near):
    """Slab test of a ray against the eight child boxes of a node.

    Args:
        typing_context: numba's, unused.
        boxes: (M, 6, 8) float32 lowest x y z, highest x y z; empty children have +inf in all six.
        node: Index into `boxes`.
        origin: Tuple of three float64.
        inverse: Tuple of three float64, 1 / direction, finite.
        t_stop: float64; boxes entered beyond it are missed.
        t_near: (8,) float64, receives the entry depths (>= 0), meaningful where the bit is set.

    Returns:
        int64 with bit k set where the ray meets box k.
    """
    del typing_context
    triple = types.UniTuple(types.float64, 3)
    signature = types.int64(boxes, types.int64, triple, triple, types.float64, t_near)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        box_type, out_type = sig.args[0], sig.args[5]
        data = context.make_array(box_type)(context, builder, args[0]).data
        out = context.make_array(out_type)(context, builder, args[5]).data
        double, lanes = ir.DoubleType(), 8
        wide = ir.VectorType(double, lanes)

        def splat(scalar: Any) -> Any:
            single = builder.insert_element(ir.Constant(wide, ir.Undefined), scalar, ir.Constant(ir.IntType(32), 0))
            zeros = ir.Constant(ir.VectorType(ir.IntType(32), lanes), [0] * lanes)
            return builder.shuffle_vector(single, ir.Constant(wide, ir.Undefined), zeros)

        def least(a: Any, b: Any) -> Any:
            return builder.select(builder.fcmp_ordered("<", a, b), a, b)

        def most(a: Any, b: Any) -> Any:
            return builder.select(builder.fcmp_ordered(">", a, b), a, b)

        first = builder.mul(args[1], ir.Constant(ir.IntType(64), 6 * lanes))

        def load(row: int) -> Any:
            offset = builder.add(first, ir.Constant(ir.IntType(64), row * lanes))
            pointer = builder.bitcast(builder.gep(data, [offset]), ir.VectorType(ir.FloatType(), lanes).as_pointer())
            return builder.fpext(builder.load(pointer, align=4), wide)

        near, far = ir.Constant(wide, [0.0] * lanes), splat(args[4])
        for axis in range(3):
            o = splat(builder.extract_value(args[2], axis))
            i = splat(builder.extract_value(args[3], axis))
            a = builder.fmul(builder.fsub(load(axis), o), i)
            b = builder.fmul(builder.fsub(load(3 + axis), o), i)
            near, far = most(near, least(a, b)), least(far, most(a, b))
        infinite = ir.Constant(wide, [float("inf")] * lanes)
        met = builder.and_(builder.fcmp_ordered("<=", near, far), builder.fcmp_ordered("<", near, infinite))
        pointer = builder.bitcast(out, wide.as_pointer())
        builder.store(near, pointer, align=8)
        mask = builder.bitcast(met, ir.IntType(lanes))
        return builder.zext(mask, ir.IntType(64))

    return signature, generate
