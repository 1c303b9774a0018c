"""What threads of one kernel share: a counter that gives out work, and largest values.

numba cuts a `prange` into one part a thread. Parts of unequal cost leave threads idle, and so does a thread that other
programs interrupt. Kernels instead run `prange(WORKERS)`, and each worker takes units of work from a counter until none
is left: the first worker of each thread does the work. Results do not depend on who took what.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

__all__ = ["WORKERS", "raise_to", "take_next"]

WORKERS = 256
"""Most threads that share the work of a kernel."""

_I64 = ir.IntType(64)


@intrinsic
def take_next(typing_context: Any, counter: Any) -> Any:
    """Return the first entry of an int64 array and add 1 to it, atomically."""
    del typing_context

    def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        place = context.make_array(signature.args[0])(context, builder, args[0]).data
        return builder.atomic_rmw("add", place, ir.Constant(_I64, 1), "monotonic")

    return types.int64(counter), build


@intrinsic
def raise_to(typing_context: Any, values: Any, place: Any, value: Any) -> Any:
    """Raise an entry of a contiguous float32 array to at least `value`, atomically; neither is negative.

    Such numbers are ordered like their bits.
    """
    del typing_context, place, value

    def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        bits = ir.IntType(32)
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        pointer = builder.bitcast(builder.gep(data, [args[1]]), bits.as_pointer())
        builder.atomic_rmw("umax", pointer, builder.bitcast(args[2], bits), "monotonic")
        return context.get_dummy_value()

    return types.void(values, types.int64, types.float32), build
