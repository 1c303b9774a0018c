"""Pack which Gaussian each Gaussian replaces in 32 bits, for the kernels: nearly every Gaussian replaces just one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsvis.abr._kernels import plan

__all__ = ["pack_single_links"]

I32 = NDArray[np.int32]
I64 = NDArray[np.int64]


def pack_single_links(counts: I64, ranks: I32, units: I32) -> tuple[NDArray[np.uint32], I32]:
    """Return `Links.only` (N,) and `Links.firsts` (W,) of N Gaussians in W words of 64.

    Args:
        counts: (N,) number of Gaussians that each Gaussian replaces.
        ranks: (M,) numbers of the replaced Gaussians, in [0, E), those of Gaussian 0 first.
        units: (M,) area of the replacing Gaussian in `UNITS`, for each of `ranks`.
    """
    n = len(counts)
    none = np.iinfo(np.int32).max
    has_one = counts == 1
    starts = np.cumsum(counts) - counts
    replaced = np.full(-(-n // 64) * 64, none, np.int32)
    replaced[:n][has_one] = ranks[starts[has_one]]
    firsts = replaced.reshape(-1, 64).min(axis=1)
    firsts[firsts == none] = 0
    near = replaced[:n].astype(np.int64) - np.repeat(firsts, 64)[:n]
    fits = has_one & (near < (1 << 16) + plan.SEVERAL)
    only = np.where(counts == 0, (1 << 16) + plan.NONE, (1 << 16) + plan.SEVERAL).astype(np.uint32)
    only[fits] = (units[starts[fits]].astype(np.int64) << 16 | near[fits]).astype(np.uint32)
    return only, firsts
