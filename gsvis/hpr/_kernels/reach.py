"""Test sixteen neighboring Gaussians of a cluster at a time against a square of pixels."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from gsvis._kernels.simd import Builder, Vector
from gsvis.hpr._kernels.sphere import CLAMP, DILATION, NEAR

__all__ = ["CLUSTER", "LANES", "find_reaching"]

CLUSTER = 64
LANES = 16
_MARGIN = 0.05  # pixels, for rounding
_I64 = ir.IntType(64)


@intrinsic
def find_reaching(typing_context, columns, first, axes, toward, half, box):
    """Find the Gaussians that may reach a pixel of a box on a face.

    Args:
        typing_context: The typing context of numba, unused.
        columns: (B, 5, CLUSTER) float32: x, y, z of the mean, largest scale times reach, reach; NaN for no Gaussian.
        first: int64, flat index in `columns` of the x of the first of the sixteen.
        axes: Three int64: the axis along which the face looks, the axis of its columns, the axis of its rows.
        toward: Four float32: 1 or -1 for the direction of the face, then the eye's coordinates on these three axes.
        half: float32, half the side of the face in pixels.
        box: Four float32: first and last column, first and last row; centers of pixels.

    Returns:
        uint64, bit k is set if the k-th of the sixteen may reach the box.
    """
    del typing_context
    f32 = types.float32
    i64 = types.int64
    tuples = types.UniTuple(i64, 3), types.UniTuple(f32, 4), f32, types.UniTuple(f32, 4)
    signature = types.uint64(columns, i64, *tuples)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Emit the code."""
        lanes = Builder(builder, LANES, "float32")
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        axes = cgutils.unpack_tuple(builder, args[2], 3)
        sign, *eye = (lanes.splat(entry) for entry in cgutils.unpack_tuple(builder, args[3], 4))
        half = lanes.splat(args[4])
        x_low, x_high, y_low, y_high = (lanes.splat(entry) for entry in cgutils.unpack_tuple(builder, args[5], 4))

        def column(k: Any) -> Vector:
            """Return sixteen values of column k."""
            return lanes.load(data, builder.add(args[1], builder.mul(k, ir.Constant(_I64, CLUSTER))))

        z, u, v = (column(k) - e for k, e in zip(axes, eye, strict=True))
        z = z * sign
        inverse = lanes.constant(1.0) / z
        wide = column(ir.Constant(_I64, 3)) * half * inverse
        sigmas = column(ir.Constant(_I64, 4))
        tangents = [u * inverse, v * inverse]
        clamped = [t.most(-CLAMP).least(CLAMP) for t in tangents]
        skew = clamped[0].times_plus(clamped[0], clamped[1].times_plus(clamped[1], 1.0))
        radius = lanes.call("llvm.sqrt", wide * wide * skew + sigmas * sigmas * DILATION) + _MARGIN
        x, y = (t.times_plus(half, half) for t in tangents)
        reaches = z.compare(">", NEAR) & (x + radius).compare(">=", x_low) & (x - radius).compare("<=", x_high)
        return (reaches & (y + radius).compare(">=", y_low) & (y - radius).compare("<=", y_high)).bits()

    return signature, generate
