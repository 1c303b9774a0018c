"""Packed sets, for kernels: a set is an array of uint64 words; bit i % 64 of word i // 64 is set if i is a member."""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from gsvis._kernels.compiled import kernel, njit

__all__ = ["bits_of", "count", "has", "lowest", "ones"]


@intrinsic
def bits_of(typing_context: Any, number: Any) -> Any:
    """Return the bits of a float32 as a uint64; for numbers >= 0 they have the order of the numbers."""

    def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.zext(builder.bitcast(args[0], ir.IntType(32)), ir.IntType(64))

    return types.uint64(types.float32), build


@intrinsic
def ones(typing_context: Any, word: Any) -> Any:
    """Return the number of set bits of a uint64."""

    def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.ctpop(args[0])

    return types.uint64(types.uint64), build


@intrinsic
def lowest(typing_context: Any, word: Any) -> Any:
    """Return the index of the lowest set bit of a uint64 that is not 0."""

    def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return types.uint64(types.uint64), build


@njit(inline="always")
def has(words, i):
    """Return whether a packed set has member i."""
    return (words[i >> 6] >> np.uint64(i & 63)) & np.uint64(1) != 0


@kernel
def count(words):
    """Return the number of members of a packed set."""
    total = 0
    for w in range(len(words)):
        total += np.int64(ones(words[w]))
    return total
