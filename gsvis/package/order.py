"""The order of Gaussians in a package: by level, by lattice, along a Morton curve, then within a chunk by coverage.

This module also decides where parts begin. Gaussians with the same levels are adjacent, and neighbors in space on one
lattice are near each other. The order depends only on the Gaussians, not on their order in the input. Scene frame and
units.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from gsvis._sorting import stable_order
from gsvis.files.mapped import release_mapped
from gsvis.package._kernels import records as kernels
from gsvis.package.codec import chunk_starts
from gsvis.package.lattice import MOST_RUNS, Lattices, find_lattices
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.scene.morton import morton_codes

__all__ = ["MOST_GAUSSIANS", "PackageOrder", "in_package_order"]

I64 = NDArray[np.int64]
U64 = NDArray[np.uint64]

MOST_GAUSSIANS = 1 << 15
"""Most Gaussians of a part: 512 KiB of records."""

_TOP = 60  # bits of a code below the three bits of the eight largest cells


@dataclass(frozen=True, eq=False)
class PackageOrder:
    """The order of N Gaussians, with the starts of parts and chunks.

    Attributes:
        permutation: (N,) ids of the Gaussians in the order of the package.
        starts: (P + 1,) first Gaussian of each part, and N. A part is a cell of the curve, or neighboring cells of one
            parent. Its Gaussians have the same first and last level and are on the same lattice. So an edit changes
            only the parts of the edited Gaussians.
        chunks: (C,) first Gaussian of each chunk.
        lattices: The lattices of the centers, in the order of the package.
    """

    permutation: I64
    starts: I64
    chunks: I64
    lattices: Lattices

    @classmethod
    def from_levels(cls, levels: Levels, *, runs: int = MOST_RUNS) -> PackageOrder:
        """Return the order for levels.

        Args:
            levels: The levels.
            runs: Runs of neighbors in which lattices are looked for, at most.
        """
        union = levels.union
        codes = morton_codes(union.means, *_curve_frame(union))
        keys = levels.first.astype(np.int64) * 16 + (15 - levels.last)
        order = stable_order(codes)
        order = order[_order_of_few(keys[order])]
        order = _sort_ties(union, codes, keys, order)
        lattices = find_lattices(union.means[order], runs=runs)
        order, lattices = _sort_by_lattice(order, keys[order], lattices)
        codes = codes[order]
        keys = keys[order] * (len(lattices) + 1) + lattices.of
        cuts = [0]
        groups = np.append(np.flatnonzero(np.diff(keys, prepend=-2)), len(keys)).tolist()
        for low, high in pairwise(groups):
            cuts += [end for _, end in _split_parts(codes, low, high, _TOP)]
        plain = union.without_harmonics()[order]
        chunks = chunk_starts(plain, cuts=cuts[1:-1], finest=_small_scale(union), lattices=lattices)
        inner = np.empty(len(order), np.int64)
        kernels.sort_chunks(chunks, _coverages(plain), inner)
        return cls(order[inner], np.array(cuts, np.int64), chunks, lattices[inner])

    def sort(self, levels: Levels) -> Levels:
        """Return the levels that the order is of, with their union in this order.

        Args:
            levels: The levels as they were given to `from_levels`.
        """
        ids = self.permutation
        return Levels(levels.union[ids], levels.first[ids], levels.last[ids], levels.names)

    def of_sorted(self) -> PackageOrder:
        """Return the order of the levels that `sort` returns, which `from_levels` finds for them too."""
        return replace(self, permutation=np.arange(len(self.permutation)))


def in_package_order(levels: Levels) -> Levels:
    """Return the levels with their union in the order of a package, as `write_package` requires.

    Build visible sets, colors and active terms for the returned levels: ids are places in their union.

    Args:
        levels: Levels in any order.
    """
    return PackageOrder.from_levels(levels).sort(levels)


def _curve_frame(g: Gaussians) -> tuple[NDArray[np.float64], float]:
    """Return the center (3,) and half width of the curve's even part, rounded so that few edits change them."""
    if len(g) == 0:
        return np.zeros(3), 1.0
    low, high = np.quantile(g.means.astype(np.float64), [0.02, 0.98], axis=0)
    widest = float((high - low).max()) / 2.0
    half = 2.0 ** float(np.ceil(np.log2(widest))) if widest > 1e-30 else 1.0
    return np.rint((low + high) / 2.0 / (half / 8.0)) * (half / 8.0), half


def _small_scale(g: Gaussians) -> float:
    """Return the scale of the smallest Gaussians, a 2% quantile, rounded so that few edits change it."""
    if len(g) == 0:
        return 0.0
    small = float(np.quantile(g.scales.max(axis=1).astype(np.float64), 0.02))
    return float(2.0 ** np.floor(np.log2(small)))


def _coverages(g: Gaussians) -> NDArray[np.float64]:
    """Return estimates of coverage (N,): opacity times a measure of the mean cross-section."""
    s = g.scales.astype(np.float64)
    return np.asarray(g.opacities * (s[:, 0] * s[:, 1] + s[:, 1] * s[:, 2] + s[:, 2] * s[:, 0]))


def _sort_ties(g: Gaussians, codes: U64, keys: I64, order: I64) -> I64:
    """Return the order in which Gaussians in the same cell of the curve are sorted by their values."""
    same = (np.diff(codes[order]) == 0) & (np.diff(keys[order]) == 0)
    tied = np.flatnonzero(np.append(same, False) | np.insert(same, 0, False))
    if len(tied) == 0:
        return order
    some = order[tied]
    arrays = (g.means, g.scales, g.quats, g.opacities[:, None], g.sh0, g.shN)
    content = np.concatenate([array[some].reshape(len(some), -1) for array in arrays], axis=1)
    release_mapped([g.shN])  # few Gaussians, but they lie in nearly all pages
    order = order.copy()
    order[tied] = some[np.lexsort((*content.T[::-1], codes[some], keys[some]))]
    return order


def _order_of_few(keys: I64) -> I64:
    """Return the stable order of keys (N,) from 0 to 65,535, which numpy sorts by their digits."""
    return np.argsort(keys.astype(np.uint16), kind="stable")


def _sort_by_lattice(order: I64, keys: I64, lattices: Lattices) -> tuple[I64, Lattices]:
    """Sort Gaussians of equal keys by their lattice; return the new order, and the lattices in it."""
    places = _order_of_few(keys * (len(lattices) + 1) + lattices.of + 1)
    return order[places], lattices[places]


def _split_parts(codes: U64, low: int, high: int, shift: int) -> list[tuple[int, int]]:
    """Split Gaussians [low, high) into ranges of at most `MOST_GAUSSIANS`, each a cell of the curve.

    Neighboring small cells of one parent are joined.

    Args:
        codes: Ascending codes of all Gaussians.
        low: First Gaussian.
        high: End.
        shift: Bits of a code below the three bits of the cells to split by.
    """
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
            found += _split_parts(codes, start, stop, shift - 3)
        joins = small
    return found
