"""Blend one Gaussian into sixteen pixels of a row, as explicit vectors: update transmittance, keep the largest weight.

The row is `p(k) = c + l k + a k^2` = log2 alpha over its pixels k = 0..15, which is accurate in float32 wherever the
Gaussian's center lies.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from gsvis._kernels.simd import Builder

__all__ = ["LANES", "largest_of", "pass_row"]

LANES = 16
_LOG2_255 = 7.994353436858858
_I64 = ir.IntType(64)


@intrinsic
def pass_row(typing_context, light, offset, c, slope, a, spent, most):
    """Blend a Gaussian into 16 pixels.

    Args:
        typing_context: The typing context of numba, unused.
        light: float32 array, C-contiguous; the transmittance of the pixels, changed in place where it is not spent.
        offset: Index of the first pixel in it.
        c: log2 alpha at the first pixel.
        slope: Linear term of log2 alpha.
        a: Quadratic term.
        spent: Transmittance below which a pixel is spent.
        most: (32,) float32, changed in place: largest weight and largest light, lane by lane. Spent pixels do not
            count.

    Returns:
        int64, bit k set if pixel k became spent.
    """
    del typing_context
    f32 = types.float32
    signature = types.int64(light, types.int64, f32, f32, f32, f32, most)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        lanes = Builder(builder, LANES, "float32")
        pixels = context.make_array(sig.args[0])(context, builder, args[0]).data
        found = context.make_array(sig.args[6])(context, builder, args[6]).data
        k = lanes.counting()
        p = lanes.splat(args[4]).times_plus(k, lanes.splat(args[3])).times_plus(k, lanes.splat(args[2]))
        before = lanes.load(pixels, args[1])
        limit = lanes.splat(args[5])
        seen = p.compare(">=", -_LOG2_255) & before.compare(">=", limit)
        weight = seen.where(p.exp2().least(0.999), 0.0) * before
        after = before - weight
        lanes.store(after, pixels, args[1])
        lit = seen.where(before, 0.0)
        for vector, first in ((weight, 0), (lit, LANES)):
            place = ir.Constant(_I64, first)
            lanes.store(lanes.load(found, place).most(vector), found, place)
        return (seen & after.compare("<", limit)).bits()

    return signature, generate


@intrinsic
def largest_of(typing_context, most, which):
    """Return the largest of lanes 16 * which .. 16 * which + 15, and set them to 0."""
    del typing_context
    signature = types.float32(most, types.int64)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        lanes = Builder(builder, LANES, "float32")
        found = context.make_array(sig.args[0])(context, builder, args[0]).data
        place = builder.mul(args[1], ir.Constant(_I64, LANES))
        largest = lanes.load(found, place).largest()
        lanes.store(lanes.constant(0.0), found, place)
        return largest

    return signature, generate
