"""The stored order of the Gaussians, and the parents of cells: what makes a store small.

Gaussians that the same cells see get the same label, and are stored label by label, in scene order within one.
Labels come from signatures, one bit for each of some key cells. All of it is integer arithmetic: the same input gives
the same order on every machine, with any number of threads.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from gsvis.visibility import _codec
from gsvis.visibility import _kernels_store as kernels

__all__ = ["KEY_CELLS", "MAX_DEPTH", "choose_labels", "key_cells", "order_of", "parents_of"]

KEY_CELLS = 128
"""Cells whose sets make the signatures; more gain little and cost memory, N / 8 bytes each."""
MAX_DEPTH = 4
"""Longest chain of parents, so that no query for classes decodes more than five cells."""

_CLUSTERS = (0, 256, 1024)  # labels tried; 0 leaves scene order as it is
_SAMPLE = 65_536  # signatures that centres are found from
_ROUNDS = 8
_TRIAL_CELLS = 12

U16 = NDArray[np.uint16]
U64 = NDArray[np.uint64]


def key_cells(cells: int) -> NDArray[np.int64]:
    """Up to 128 cells, evenly spread over their numbers."""
    count = min(KEY_CELLS, cells)
    return np.arange(count) * cells // max(1, count)


def order_of(labels: U16) -> NDArray[np.int32]:
    """(N,) the Gaussian at each stored position: by label, then by id."""
    return np.argsort(labels, kind="stable").astype(np.int32)


def choose_labels(n: int, cells: int, read: Callable[[int], U64]) -> U16:
    """The labels that make the whole file smallest, judged by some of the cells.

    Args:
        n: N Gaussians.
        cells: C.
        read: Gives the set of a cell in scene order.

    Returns:
        (N,) uint16; all 0 where no order beats that of the scene.
    """
    keys = key_cells(cells)
    signatures = np.zeros((n, -(-max(1, len(keys)) // 64)), np.uint64)
    for bit, cell in enumerate(keys.tolist()):
        kernels.add_signature(read(cell), bit, signatures)
    trials = [read(cell) for cell in keys[:: -(-len(keys) // _TRIAL_CELLS)].tolist()]
    best, least = np.zeros(n, np.uint16), np.inf
    for clusters in _CLUSTERS:
        if clusters and n < 64 * clusters:
            continue
        labels = _cluster(signatures, clusters) if clusters else np.zeros(n, np.uint16)
        size = len(_codec.compress(labels.tobytes())) + cells / len(trials) * _trial_size(trials, labels)
        if size < least:
            best, least = labels, size
    return best


def _trial_size(trials: list[U64], labels: U16) -> int:
    places = np.empty(len(labels), np.int32)
    places[order_of(labels)] = np.arange(len(labels), dtype=np.int32)
    total = 0
    for words in trials:
        stored = np.zeros_like(words)
        kernels.scatter(words, places, stored)
        total += len(_codec.encode_set(stored))
    return total


def _cluster(signatures: U64, clusters: int) -> U16:
    """Labels (N,) by k-modes: centres are bitwise majorities, distances are counts of differing bits.

    Label 0 is the centre with the fewest bits; each further one is the nearest to the one before that is left.
    """
    seen = np.flatnonzero(signatures.any(axis=1))
    if len(seen) < clusters:
        return np.zeros(len(signatures), np.uint16)
    count = min(_SAMPLE, len(seen))
    sample = np.ascontiguousarray(signatures[seen[np.arange(count) * len(seen) // count]])
    centres = np.ascontiguousarray(sample[np.arange(clusters) * count // clusters])
    labels = np.zeros(count, np.int64)
    for _ in range(_ROUNDS):
        kernels.nearest_centres(sample, centres, labels)
        centres = _majorities(sample, labels, centres)
    everywhere = np.zeros(len(signatures), np.int64)
    kernels.nearest_centres(signatures, centres, everywhere)
    return _rank_in_chain(centres)[everywhere]


def _majorities(sample: U64, labels: NDArray[np.int64], centres: U64) -> U64:
    bits = np.zeros((len(centres), 64 * centres.shape[1]), np.int64)
    sizes = np.zeros(len(centres), np.int64)
    kernels.count_bits(sample, labels, bits, sizes)
    major = np.packbits(2 * bits > sizes[:, None], axis=1, bitorder="little")
    packed = np.ascontiguousarray(major).view("<u8").astype(np.uint64, copy=False)
    return np.where(sizes[:, None] > 0, packed, centres)


def _rank_in_chain(centres: U64) -> U16:
    """(K,) place of each centre in a chain that steps to the nearest centre that is left."""
    bits = np.unpackbits(centres.astype("<u8").view(np.uint8), axis=1).astype(np.int32)
    counts = bits.sum(axis=1)
    ranks = np.zeros(len(centres), np.uint16)
    left = np.ones(len(centres), bool)
    at = int(counts.argmin())
    for rank in range(len(centres)):
        ranks[at], left[at] = rank, False
        apart = np.where(left, counts - 2 * (bits @ bits[at]), np.iinfo(np.int32).max)
        at = int(apart.argmin())
    return ranks


def parents_of(edges: list[tuple[int, int, int]], cells: int) -> NDArray[np.int32]:
    """A parent for each cell, -1 for none, so that cells share much with their parents and no chain is long.

    Grows trees from the cell that shares most with its neighbours, always along the strongest pair that reaches a new
    cell and keeps the depth.

    Args:
        edges: Pairs of neighbours (shared, a, b): how many Gaussians both see.
        cells: C.
    """
    beside: list[list[tuple[int, int]]] = [[] for _ in range(cells)]
    for shared, a, b in edges:
        if shared > 0:
            beside[a].append((shared, b))
            beside[b].append((shared, a))
    parents, depths = np.full(cells, -1, np.int32), np.full(cells, -1)
    strength = [sum(shared for shared, _ in pairs) for pairs in beside]
    for root in sorted(range(cells), key=lambda cell: (-strength[cell], cell)):
        if depths[root] >= 0:
            continue
        depths[root] = 0
        waiting = [(-shared, root, cell) for shared, cell in beside[root]]
        heapq.heapify(waiting)
        while waiting:
            _, parent, cell = heapq.heappop(waiting)
            if depths[cell] >= 0:
                continue
            parents[cell], depths[cell] = parent, depths[parent] + 1
            if depths[cell] < MAX_DEPTH:
                for shared, further in beside[cell]:
                    if depths[further] < 0:
                        heapq.heappush(waiting, (-shared, cell, further))
    return parents
