"""Test sixteen neighboring Gaussians of a cluster at a time against a square of pixels, and place them there."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from gsvis._kernels.simd import Builder, Vector
from gsvis.hpr._kernels.sphere import CLAMP, DILATION, NEAR

__all__ = ["CLUSTER", "LANES", "PLACED", "find_reaching"]

CLUSTER = 64
LANES = 16
PLACED = 6
"""Vectors of results: first and last column, first and last row, squared distance, cover."""
_MARGIN = 0.05  # pixels, for rounding
_I64 = ir.IntType(64)


@intrinsic
def find_reaching(typing_context, columns, first, axes, toward, eye, half, box, frame, placed):
    """Find the Gaussians that may reach a pixel of a box on a face, and where they lie in a square of the face.

    Args:
        typing_context: The typing context of numba, unused.
        columns: (B, 5, CLUSTER) float32: x, y, z of the mean, largest scale times reach, reach; NaN for no Gaussian.
        first: int64, flat index in `columns` of the x of the first of the sixteen.
        axes: Three int64: the axis along which the face looks, the axis of its columns, the axis of its rows.
        toward: Four float32: 1 or -1 for the direction of the face, then the eye's coordinates on these three axes.
        eye: Three float32: the eye.
        half: float32, half the side of the face in pixels.
        box: Four float32: first and last column, first and last row; centers of pixels of the face.
        frame: Four float32: first column and first row of the square, its last column and last row in the square.
        placed: (6 * 16,) float32, receives for each of the sixteen the first and the last column and the first and the
            last row in the square that it may reach, the squared distance of its mean, and an upper bound of its cover,
            the share of a blurred splat that the Gaussian covers.

    Returns:
        uint64, bit k is set if the k-th of the sixteen may reach the box.
    """
    del typing_context
    f32 = types.float32
    i64 = types.int64
    quad = types.UniTuple(f32, 4)
    tuples = types.UniTuple(i64, 3), quad, types.UniTuple(f32, 3), f32, quad, quad
    signature = types.uint64(columns, i64, *tuples, placed)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Emit the code."""
        lanes = Builder(builder, LANES, "float32")
        data, out = (context.make_array(sig.args[k])(context, builder, args[k]).data for k in (0, 8))
        axes = cgutils.unpack_tuple(builder, args[2], 3)
        sign, *center = (lanes.splat(entry) for entry in cgutils.unpack_tuple(builder, args[3], 4))
        world = [lanes.splat(entry) for entry in cgutils.unpack_tuple(builder, args[4], 3)]
        half = lanes.splat(args[5])
        x_low, x_high, y_low, y_high = (lanes.splat(entry) for entry in cgutils.unpack_tuple(builder, args[6], 4))
        left, top, right, bottom = (lanes.splat(entry) for entry in cgutils.unpack_tuple(builder, args[7], 4))

        def column(k: Any) -> Vector:
            """Return sixteen values of column k."""
            return lanes.load(data, builder.add(args[1], builder.mul(k, ir.Constant(_I64, CLUSTER))))

        z, u, v = (column(k) - e for k, e in zip(axes, center, strict=True))
        z = z * sign
        inverse = lanes.constant(1.0) / z
        wide = column(ir.Constant(_I64, 3)) * half * inverse
        sigmas = column(ir.Constant(_I64, 4))
        tangents = [u * inverse, v * inverse]
        clamped = [t.most(-CLAMP).least(CLAMP) for t in tangents]
        skew = clamped[0] * clamped[0] + 1.0 + clamped[1] * clamped[1]
        reach = lanes.call("llvm.sqrt", wide * wide * skew + sigmas * sigmas * DILATION)
        radius = reach + _MARGIN
        x, y = (t.times_plus(half, half) for t in tangents)
        reaches = z.compare(">", NEAR) & (x + radius).compare(">=", x_low) & (x - radius).compare("<=", x_high)
        reaches = reaches & (y + radius).compare(">=", y_low) & (y - radius).compare("<=", y_high)
        area = wide * wide / (sigmas * sigmas) * skew
        dx, dy, dz = (column(ir.Constant(_I64, k)) - world[k] for k in range(3))
        found = []
        for middle, begin, end in ((x, left, right), (y, top, bottom)):
            place = middle - begin
            found.append(lanes.call("llvm.ceil", place - reach - 0.5).most(0.0))
            found.append(lanes.call("llvm.floor", place + reach - 0.5).least(end))
        found += [dx * dx + dy * dy + dz * dz, area / (area + DILATION)]
        for k, vector in enumerate(found):
            lanes.store(vector, out, ir.Constant(_I64, k * LANES))
        return reaches.bits()

    return signature, generate
