"""Which Gaussians replace which, laid out for the kernels: nearly every Gaussian replaces one, found in 32 bits.

Ids, numbers of the replaced and areas only; what a client holds is in `planner.py`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsvis.abr._kernels import plan

__all__ = ["only_links"]

I32 = NDArray[np.int32]
I64 = NDArray[np.int64]


def only_links(counts: I64, ranks: I32, units: I32) -> tuple[NDArray[np.uint32], I32]:
    """Return `Links.only` and `Links.firsts` of the Gaussians of some words.

    Args:
        counts: (N,) how many Gaussians each replaces.
        ranks: Their numbers, for each.
        units: Area of the Gaussian, for each of `ranks`.
    """
    one = counts == 1
    starts = np.cumsum(counts) - counts
    padded = -(-len(counts) // 64) * 64
    number = np.full(padded, np.iinfo(np.int32).max, np.int32)
    number[: len(counts)][one] = ranks[starts[one]]
    firsts = number.reshape(-1, 64).min(axis=1)
    firsts[firsts == np.iinfo(np.int32).max] = 0
    near = number[: len(counts)].astype(np.int64) - np.repeat(firsts, 64)[: len(counts)]
    fits = one & (near < (1 << 16) + plan.SEVERAL)
    only = np.where(counts == 0, (1 << 16) + plan.NONE, (1 << 16) + plan.SEVERAL).astype(np.uint32)
    only[fits] = (units[starts[fits]].astype(np.int64) << 16 | near[fits]).astype(np.uint32)
    return only, firsts
