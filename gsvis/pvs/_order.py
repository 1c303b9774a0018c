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

from gsvis.pvs import codec as _codec
from gsvis.pvs._kernels import store as kernels

__all__ = ["KEY_CELLS", "MAX_DEPTH", "choose_labels", "key_cells", "order_of", "parents_of"]

KEY_CELLS = 128
"""Cells whose sets make the signatures; more gain little and cost memory, N / 8 bytes each."""
MAX_DEPTH = 4
"""Longest chain of parents, so that no query for classes decodes more than five cells."""

_SIDES = (0, 16, 64, 128)  # numbers of labels tried, as square roots; 0 leaves scene order as it is
_SAMPLE = 131_072  # signatures that centers are found from
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
    for side in _SIDES:
        if n < 16 * side * side:
            break
        labels = _cluster(signatures, side) if side else np.zeros(n, np.uint16)
        size = len(_codec.encode_labels(labels)) + cells / len(trials) * _trial_size(trials, labels)
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


def _cluster(signatures: U64, side: int) -> U16:
    """Labels (N,), up to side x side of them: clusters of clusters, so that two short searches do for a long one.

    Label 0 has the fewest bits; each further one is the nearest to the one before that is left, first among the
    large clusters and then inside each.
    """
    seen = np.flatnonzero(signatures.any(axis=1))
    count = min(_SAMPLE, len(seen))
    if count < side * side:
        return np.zeros(len(signatures), np.uint16)
    sample = signatures[seen[np.arange(count) * len(seen) // count]]
    centers = _centers(sample, side)
    of_sample, of_all = _nearest(sample, centers), _nearest(signatures, centers)
    labels, used = np.zeros(len(signatures), np.uint16), 0
    for cluster in range(side):
        members, part = np.flatnonzero(of_all == cluster), sample[of_sample == cluster]
        fine = round(side * side * len(part) / count)
        if fine > 1:
            labels[members] = used + _nearest(signatures[members], _centers(part, fine))
        else:
            labels[members] = used
        used += max(1, fine)
    return labels


def _centers(sample: U64, count: int) -> U64:
    """(K, W) centers by k-modes, in a chain: bitwise majorities, distances are counts of differing bits."""
    centers = np.ascontiguousarray(sample[np.arange(count) * len(sample) // count])
    for _ in range(_ROUNDS):
        centers = _majorities(sample, _nearest(sample, centers), centers)
    return np.ascontiguousarray(centers[_chain(centers)])


def _nearest(signatures: U64, centers: U64) -> NDArray[np.int64]:
    if signatures.shape[1] == 1:  # few cells have few different signatures
        distinct, which = np.unique(signatures[:, 0], return_inverse=True)
        if 4 * len(distinct) < len(signatures):
            return np.asarray(_nearest_of(distinct[:, None], centers)[which])
    return _nearest_of(signatures, centers)


def _nearest_of(signatures: U64, centers: U64) -> NDArray[np.int64]:
    labels = np.zeros(len(signatures), np.int64)
    kernels.nearest_centers(np.ascontiguousarray(signatures), centers, labels)
    return labels


def _majorities(sample: U64, labels: NDArray[np.int64], centers: U64) -> U64:
    bits = np.zeros((len(centers), 64 * centers.shape[1]), np.int64)
    sizes = np.zeros(len(centers), np.int64)
    kernels.count_bits(sample, labels, bits, sizes)
    major = np.packbits(2 * bits > sizes[:, None], axis=1, bitorder="little")
    packed = np.ascontiguousarray(major).view("<u8").astype(np.uint64, copy=False)
    return np.where(sizes[:, None] > 0, packed, centers)


def _chain(centers: U64) -> NDArray[np.int64]:
    """(K,) the centers, from the one with the fewest bits always on to the nearest that is left."""
    bits = np.unpackbits(centers.astype("<u8").view(np.uint8), axis=1).astype(np.int32)
    counts = bits.sum(axis=1)
    chain = np.empty(len(centers), np.int64)
    left = np.ones(len(centers), bool)
    at = int(counts.argmin())
    for place in range(len(centers)):
        chain[place], left[at] = at, False
        apart = np.where(left, counts - 2 * (bits @ bits[at]), np.iinfo(np.int32).max)
        at = int(apart.argmin())
    return chain


def parents_of(edges: list[tuple[int, int, int]], cells: int) -> NDArray[np.int32]:
    """A parent for each cell, -1 for none, so that cells share much with their parents and no chain is long.

    Grows trees from the cell that shares most with its neighbors, always along the strongest pair that reaches a new
    cell and keeps the depth.

    Args:
        edges: Pairs of neighbors (shared, a, b): how many Gaussians both see.
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
