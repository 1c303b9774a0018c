"""The order of a package: by level, then along a Morton curve, within a chunk by what is seen most; where parts begin.

Gaussians that leave together with an upgrade stand together, and so do neighbors. The order depends on what the
Gaussians are, never on how they came: a permutation changes nothing. Scene frame and units.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from gsvis.package._kernels import records as kernels
from gsvis.package.codec import chunk_starts
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels

__all__ = ["MOST_GAUSSIANS", "PackageOrder", "in_package_order", "morton_codes"]

I64 = NDArray[np.int64]
U64 = NDArray[np.uint64]

MOST_GAUSSIANS = 1 << 15
"""Gaussians of a part at most: 512 KiB of records."""

_TOP = 60  # bits below the eight largest cells of the curve


@dataclass(frozen=True, eq=False)
class PackageOrder:
    """The order of N Gaussians and where it is cut.

    Attributes:
        permutation: (N,) the Gaussians in the order of the package.
        starts: (P + 1,) where its parts begin, and N: each a cell of the curve, or neighboring ones of one parent, of
            one first and last level, so that an edit changes the parts that it lies in and no others.
        chunks: (C,) where chunks begin.
    """

    permutation: I64
    starts: I64
    chunks: I64

    @classmethod
    def from_levels(cls, levels: Levels) -> PackageOrder:
        """The order for levels."""
        union = levels.union
        codes = morton_codes(union.means, *_frame(union))
        keys = levels.first.astype(np.int64) * 16 + (15 - levels.last)
        order = np.lexsort((codes, keys))
        order = _by_content(union, codes, keys, order)
        codes, keys = codes[order], keys[order]
        cuts = [0]
        groups = np.append(np.flatnonzero(np.diff(keys, prepend=-1)), len(keys)).tolist()
        for low, high in pairwise(groups):
            cuts += [end for _, end in _parts(codes, low, high, _TOP)]
        chunks = chunk_starts(union[order], cuts=cuts[1:-1], finest=_finest(union))
        inside = np.repeat(np.arange(len(chunks)), np.diff(np.append(chunks, len(order))))
        order = order[np.lexsort((-_strengths(union)[order], inside))]
        return cls(order, np.array(cuts, np.int64), chunks)


def in_package_order(levels: Levels) -> Levels:
    """The same levels with their union in the order of a package, which is what `write_package` takes.

    Visible sets, colors and active terms are to be built for what this gives: ids are places in it.

    Args:
        levels: In any order.
    """
    order = PackageOrder.from_levels(levels).permutation
    return Levels(levels.union[order], levels.first[order], levels.last[order], levels.names)


def morton_codes(means: NDArray[np.float32], center: NDArray[np.float64], half: float) -> U64:
    """Return (N,) places along a Morton curve of 2^63 cells, evenly spaced within `half` of `center` (3,).

    Args:
        means: (N, 3) positions in the frame and units of `center`.
        center: (3,) middle of the even part of the curve.
        half: Half the width of the even part, > 0; cells grow outside of it.
    """
    codes = np.empty(len(means), np.uint64)
    kernels.morton(means, center, half, codes)
    return codes


def _frame(g: Gaussians) -> tuple[NDArray[np.float64], float]:
    """Center (3,) and half width of the curve's even part, rounded so that few edits change them."""
    if len(g) == 0:
        return np.zeros(3), 1.0
    low, high = np.quantile(g.means.astype(np.float64), [0.02, 0.98], axis=0)
    widest = float((high - low).max()) / 2.0
    half = 2.0 ** float(np.ceil(np.log2(widest))) if widest > 1e-30 else 1.0
    return np.rint((low + high) / 2.0 / (half / 8.0)) * (half / 8.0), half


def _finest(g: Gaussians) -> float:
    """Size of the small Gaussians of a scene, rounded so that few edits change it."""
    if len(g) == 0:
        return 0.0
    small = float(np.quantile(g.scales.max(axis=1).astype(np.float64), 0.02))
    return float(2.0 ** np.floor(np.log2(small)))


def _strengths(g: Gaussians) -> NDArray[np.float64]:
    """(N,) opacity times mean cross-section: what each is likely to cover."""
    s = g.scales.astype(np.float64)
    return np.asarray(g.opacities * (s[:, 0] * s[:, 1] + s[:, 1] * s[:, 2] + s[:, 2] * s[:, 0]))


def _by_content(g: Gaussians, codes: U64, keys: I64, order: I64) -> I64:
    """The order, with those in the same cell of the curve by what they are."""
    same = (np.diff(codes[order]) == 0) & (np.diff(keys[order]) == 0)
    tied = np.flatnonzero(np.append(same, False) | np.insert(same, 0, False))
    if len(tied) == 0:
        return order
    some = order[tied]
    arrays = (g.means, g.scales, g.quats, g.opacities[:, None], g.sh0, g.shN)
    content = np.concatenate([array[some].reshape(len(some), -1) for array in arrays], axis=1)
    order = order.copy()
    order[tied] = some[np.lexsort((*content.T[::-1], codes[some], keys[some]))]
    return order


def _parts(codes: U64, low: int, high: int, shift: int) -> list[tuple[int, int]]:
    """Ranges of at most `MOST_GAUSSIANS`, cell by cell; neighboring small cells of one parent are joined."""
    if high - low <= MOST_GAUSSIANS:
        return [(low, high)]
    if shift < 0:  # all in one smallest cell
        return [(k, min(k + MOST_GAUSSIANS, high)) for k in range(low, high, MOST_GAUSSIANS)]
    digits = (codes[low:high] >> np.uint64(shift)) & np.uint64(7)
    ends = low + np.searchsorted(digits, np.arange(9, dtype=np.uint64))
    found: list[tuple[int, int]] = []
    joins = False
    for start, stop in zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True):
        if start == stop:
            continue
        small = stop - start <= MOST_GAUSSIANS
        if small and joins and stop - found[-1][0] <= MOST_GAUSSIANS:
            found[-1] = (found[-1][0], stop)
        else:
            found += _parts(codes, start, stop, shift - 3)
        joins = small
    return found
