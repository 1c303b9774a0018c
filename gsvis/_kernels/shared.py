"""Shared work of the threads of a kernel: a counter of work units, atomic maxima, and parallel calls of a function.

With equal parts, threads would be idle when costs differ or other programs interrupt a thread. So threads take units of
work from a counter until none is left. Results do not depend on which thread takes which unit.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

__all__ = ["raise_to", "share", "take", "take_next"]

_I64 = ir.IntType(64)
_BYTES = ir.IntType(8).as_pointer()
_PART = ir.FunctionType(ir.VoidType(), [_BYTES.as_pointer(), _I64.as_pointer(), _I64.as_pointer(), _BYTES])
"""Type of the function that numba's threads call: arrays, lengths and steps, all unused here, and a data pointer."""
_RUN = ir.FunctionType(ir.VoidType(), [_BYTES] * 5 + [_I64] * 3)
"""Type of numba's function that runs a part on all threads: the part, its four arguments, two counts, threads."""


@intrinsic
def share(typing_context: Any, function: Any, units: Any, arguments: Any) -> Any:
    """Call function(unit, *arguments) for each unit in [0, units) on numba's threads.

    The function is compiled with `inner` and must not raise. Use it in a kernel under `on_numba_threads`. Unlike a
    `prange` loop, it types the function once, and runs a single unit, or all units for one thread, where it is called:
    not every threading layer of numba may be entered by several threads at once.
    """
    call = function.get_call_type(typing_context, (types.int64, *arguments), {})

    def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        """Build the parallel call, and a direct call for a single unit or thread."""
        given = ir.LiteralStructType([_I64, _I64, args[2].type])  # next unit, number of units, arguments
        part = _build_part(context, builder.module, given, signature.args[0].dispatcher.get_compile_result(call), call)
        count = context.cast(builder, args[1], signature.args[1], types.int64)
        place = cgutils.alloca_once(builder, given)
        for k, value in enumerate((_I64(0), count, args[2])):
            builder.store(value, cgutils.gep_inbounds(builder, place, 0, k))
        data = builder.bitcast(place, _BYTES)
        none = _BYTES(None)
        ask = cgutils.get_or_insert_function(builder.module, ir.FunctionType(_I64, []), "get_num_threads")
        threads = builder.call(ask, [])
        in_parallel = builder.and_(builder.icmp_signed(">", count, _I64(1)), builder.icmp_signed(">", threads, _I64(1)))
        with builder.if_else(in_parallel) as (several, one):
            with several:
                run = cgutils.get_or_insert_function(builder.module, _RUN, "numba_parallel_for")
                size = builder.bitcast(cgutils.alloca_once_value(builder, threads), _BYTES)
                builder.call(run, [builder.bitcast(part, _BYTES), none, size, none, data, _I64(0), _I64(0), threads])
            with one:
                builder.call(part, [ir.Constant(kind, None) for kind in _PART.args[:3]] + [data])
        return context.get_dummy_value()

    return types.void(function, units, arguments), build


def _build_part(context: Any, module: Any, given: Any, compiled: Any, call: Any) -> Any:
    """Build and return the function that each thread runs: it takes units and calls the compiled function with them."""
    part = ir.Function(module, _PART, module.get_unique_name("part." + compiled.fndesc.mangled_name))
    part.linkage = "internal"
    builder = ir.IRBuilder(part.append_basic_block("start"))
    take, work, end = (part.append_basic_block(name) for name in ("take", "work", "end"))
    place = builder.bitcast(part.args[3], given.as_pointer())
    counter, count, values = (cgutils.gep_inbounds(builder, place, 0, k) for k in range(3))
    count = builder.load(count)
    values = cgutils.unpack_tuple(builder, builder.load(values))
    builder.branch(take)
    builder.position_at_end(take)
    unit = builder.atomic_rmw("add", counter, _I64(1), "monotonic")
    builder.cbranch(builder.icmp_signed("<", unit, count), work, end)
    builder.position_at_end(work)
    context.add_linking_libs([compiled.library])
    context.call_internal_no_propagate(builder, compiled.fndesc, call, [unit, *values])
    builder.branch(take)
    builder.position_at_end(end)
    builder.ret_void()
    return part


@intrinsic
def take_next(typing_context: Any, counter: Any) -> Any:
    """Return the first entry of an int64 array and add 1 to it, atomically."""
    del typing_context

    def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        """Build an atomic addition."""
        place = context.make_array(signature.args[0])(context, builder, args[0]).data
        return builder.atomic_rmw("add", place, ir.Constant(_I64, 1), "monotonic")

    return types.int64(counter), build


@intrinsic
def take(typing_context: Any, counter: Any, count: Any) -> Any:
    """Return the first entry of an int64 array and add `count` to it, atomically."""
    del typing_context, count

    def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        """Build an atomic addition."""
        place = context.make_array(signature.args[0])(context, builder, args[0]).data
        return builder.atomic_rmw("add", place, args[1], "monotonic")

    return types.int64(counter, types.int64), build


@intrinsic
def raise_to(typing_context: Any, values: Any, place: Any, value: Any) -> Any:
    """Raise an entry of a contiguous float32 array to at least `value`, atomically; neither is negative.

    Such numbers are ordered like their bits.
    """
    del typing_context, place, value

    def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        """Build an atomic maximum of the bits as integers."""
        bits = ir.IntType(32)
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        pointer = builder.bitcast(builder.gep(data, [args[1]]), bits.as_pointer())
        builder.atomic_rmw("umax", pointer, builder.bitcast(args[2], bits), "monotonic")
        return context.get_dummy_value()

    return types.void(values, types.int64, types.float32), build
