"""Which Gaussians replace which, laid out for the kernels: nearly every Gaussian replaces one, found in 32 bits.

Ids, numbers of the replaced and areas only; what a client holds is in `planner.py`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsvis.abr._kernels import plan
from gsvis.abr.index import SceneIndex

__all__ = ["links_of", "only_links"]

I32 = NDArray[np.int32]
I64 = NDArray[np.int64]


def links_of(index: SceneIndex) -> plan.Links:
    """Return which Gaussians replace which."""
    ending = np.flatnonzero(np.diff(index.replacement_offsets)).astype(np.int32)
    starts = np.append(index.replacement_offsets[ending], len(index.replacement_ids))
    offsets, owners = index.replaced
    ranks = np.searchsorted(ending, owners).astype(np.int32)
    areas = np.maximum(index.areas, np.float32(1e-30)).astype(np.float64)
    counts = np.diff(offsets)
    theirs = areas[index.replacement_ids]
    every = np.add.reduceat(theirs, starts[:-1]) if len(ending) else np.zeros(0)
    units = np.ceil(plan.UNITS * np.repeat(areas, counts) / every[ranks]).astype(np.int32)
    only, firsts = only_links(counts, ranks, units)
    return plan.Links(
        only=only,
        firsts=firsts,
        offsets=offsets,
        ranks=ranks,
        units=units,
        ending=ending,
        starts=starts,
        ids=index.replacement_ids,
        areas=theirs.astype(np.float32),
        every=every,
    )


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
