"""Choose the stored order of the Gaussians and the parents of cells, which make a store small.

Gaussians that the same cells see get the same label. The store sorts them by label, then by id. Labels come from
signatures: one bit for each key cell. All arithmetic is on integers, so the same input gives the same order on
every machine, with any number of threads.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from gsvis._kernels.bits import count
from gsvis.pvs import codec as _codec
from gsvis.pvs._kernels import store as kernels
from gsvis.pvs.completed import Completion

__all__ = ["KEY_CELLS", "MAX_DEPTH", "choose_labels", "key_cells", "order_of", "parents_in_groups", "parents_of"]

KEY_CELLS = 128
"""Cells whose sets make the signatures. More cells gain little, and each costs N / 8 bytes of memory."""
MAX_DEPTH = 4
"""Longest chain of parents. A query for classes decodes at most five cells."""

_SIDES = (16, 64, 128)  # square roots of the numbers of labels to try
_SAMPLE = 131_072  # most signatures used to find centers
_ROUNDS = 8
_TRIAL_CELLS = 12
_ADDED_A_BYTE = 8  # Gaussians by which sets are completed that weigh as much as a byte of the file

U16 = NDArray[np.uint16]
U64 = NDArray[np.uint64]


def key_cells(cells: int) -> NDArray[np.int64]:
    """Return up to 128 cells, evenly spread over the cell numbers."""
    count = min(KEY_CELLS, cells)
    return np.arange(count) * cells // max(1, count)


def order_of(labels: U16) -> NDArray[np.int32]:
    """Return (N,) int32, the Gaussian at each stored position: sorted by label, then by id."""
    order = np.empty(len(labels), np.int32)
    kernels.sort_labels(labels, order)
    return order


def choose_labels(n: int, cells: int, read: Callable[[int], U64], *, completed: bool = False) -> U16:
    """Return the labels that give the smallest file, estimated from some of the cells.

    Args:
        n: N Gaussians.
        cells: C.
        read: Returns the set of a cell in scene order, as packed words.
        completed: Whether sets will be completed by these labels.

    Returns:
        (N,) uint16; all 0 if no order beats scene order.
    """
    keys = key_cells(cells)
    signatures = np.zeros((n, -(-max(1, len(keys)) // 64)), np.uint64)
    for bit, cell in enumerate(keys.tolist()):
        kernels.add_signature(read(cell), bit, signatures)
    trials = [read(cell) for cell in keys[:: -(-len(keys) // _TRIAL_CELLS)].tolist()]
    ever = _codec.pack(np.flatnonzero(signatures.any(axis=1)), n)
    best = np.zeros(n, np.uint16)
    least = np.inf
    for labels in _candidates(signatures):
        sets = list(map(Completion(labels, ever), trials)) if completed else trials
        added = sum(count(full) - count(words) for full, words in zip(sets, trials, strict=True))
        size = len(_codec.encode_labels(labels))
        size += cells / len(trials) * (_trial_size(sets, labels) + added / _ADDED_A_BYTE)
        if size < least:
            best = labels
            least = size
    return best


def _candidates(signatures: U64) -> Iterator[U16]:
    """Yield labels (N,) to try: all 0, which keeps scene order, then increasingly fine ones.

    If there are at most as many distinct signatures as labels, each gets its own, and nothing finer follows.
    """
    n = len(signatures)
    yield np.zeros(n, np.uint16)
    if n < 16 * _SIDES[0] ** 2:
        return
    distinct = _distinct(signatures)
    for side in _SIDES:
        if n < 16 * side * side:
            return
        if distinct is not None and len(distinct[0]) <= side * side:
            chain = _chain(distinct[0])
            places = np.empty(len(chain), np.uint16)
            places[chain] = np.arange(len(chain), dtype=np.uint16)
            yield places[distinct[1]]
            return
        yield _cluster(signatures, side)


def _distinct(signatures: U64) -> tuple[U64, NDArray[np.int64]] | None:
    """Return the distinct signatures and the index of each Gaussian's (N,); None if a sample has too many."""
    step = -(-len(signatures) // _SAMPLE)
    if len(np.unique(signatures[::step], axis=0)) > _SIDES[-1] ** 2:
        return None
    return _unique(signatures)


def _unique(signatures: U64) -> tuple[U64, NDArray[np.int64]]:
    """Return the distinct signatures, ascending, and the index of each Gaussian's (N,); empty ones are not sorted."""
    seen = np.flatnonzero(signatures.any(axis=1))
    if signatures.shape[1] == 1:  # much faster than rows
        some, places = np.unique(signatures[seen, 0], return_inverse=True)
        some = some[:, None]
    else:
        some, places = np.unique(signatures[seen], axis=0, return_inverse=True)
    if len(seen) == len(signatures):
        return np.ascontiguousarray(some), places.reshape(-1)
    which = np.zeros(len(signatures), np.int64)
    which[seen] = 1 + places.reshape(-1)
    return np.concatenate([np.zeros((1, signatures.shape[1]), np.uint64), some]), which


def _trial_size(trials: list[U64], labels: U16) -> int:
    """Return the size in bytes of some sets, coded in the order by labels."""
    places = np.empty(len(labels), np.int32)
    places[order_of(labels)] = np.arange(len(labels), dtype=np.int32)
    total = 0
    for words in trials:
        stored = np.zeros_like(words)
        kernels.scatter(words, places, stored)
        total += len(_codec.encode_set(stored))
    return total


def _cluster(signatures: U64, side: int) -> U16:
    """Return labels (N,), up to side x side distinct ones.

    Signatures are clustered twice: first into large clusters, then inside each. Two short searches replace a long
    one. At both steps the cluster with the fewest bits comes first. Each next cluster is the nearest one left.
    """
    seen = np.flatnonzero(signatures.any(axis=1))
    count = min(_SAMPLE, len(seen))
    if count < side * side:
        return np.zeros(len(signatures), np.uint16)
    sample = signatures[seen[np.arange(count) * len(seen) // count]]
    centers = _centers(sample, side)
    of_sample = _nearest(sample, centers)
    of_all = _nearest(signatures, centers)
    labels = np.zeros(len(signatures), np.uint16)
    used = 0
    for cluster in range(side):
        members = np.flatnonzero(of_all == cluster)
        part = sample[of_sample == cluster]
        fine = round(side * side * len(part) / count)
        if fine > 1:
            labels[members] = used + _nearest(signatures[members], _centers(part, fine))
        else:
            labels[members] = used
        used += max(1, fine)
    return labels


def _centers(sample: U64, count: int) -> U64:
    """Return (K, W) centers by k-modes, ordered by `_chain`.

    A center is the bitwise majority of its signatures. A distance is the number of differing bits.
    """
    centers = np.ascontiguousarray(sample[np.arange(count) * len(sample) // count])
    for _ in range(_ROUNDS):
        centers = _majorities(sample, _nearest(sample, centers), centers)
    return np.ascontiguousarray(centers[_chain(centers)])


def _nearest(signatures: U64, centers: U64) -> NDArray[np.int64]:
    """Return the label of the nearest center of each signature."""
    if signatures.shape[1] == 1:  # few cells have few different signatures
        distinct, which = _unique(signatures)
        if 4 * len(distinct) < len(signatures):
            return np.asarray(_nearest_of(distinct, centers)[which])
    return _nearest_of(signatures, centers)


def _nearest_of(signatures: U64, centers: U64) -> NDArray[np.int64]:
    """Return the label of the nearest center of each signature, one by one."""
    labels = np.zeros(len(signatures), np.int64)
    kernels.nearest_centers(np.ascontiguousarray(signatures), np.ascontiguousarray(centers.T), labels)
    return labels


def _majorities(sample: U64, labels: NDArray[np.int64], centers: U64) -> U64:
    """Return the bitwise majority of the signatures of each label."""
    bits = np.zeros((len(centers), 64 * centers.shape[1]), np.int64)
    sizes = np.zeros(len(centers), np.int64)
    kernels.count_bits(sample, labels, bits, sizes)
    major = np.packbits(2 * bits > sizes[:, None], axis=1, bitorder="little")
    packed = np.ascontiguousarray(major).view("<u8").astype(np.uint64, copy=False)
    return np.where(sizes[:, None] > 0, packed, centers)


def _chain(centers: U64) -> NDArray[np.int64]:
    """Return (K,) an order of the centers: the one with the fewest bits first, then always the nearest one left."""
    bits = np.unpackbits(centers.astype("<u8").view(np.uint8), axis=1).astype(np.float32)  # exact, and fast to multiply
    counts = bits.sum(axis=1)
    chain = np.empty(len(centers), np.int64)
    left = np.ones(len(centers), bool)
    at = int(counts.argmin())
    for place in range(len(centers)):
        chain[place] = at
        left[at] = False
        apart = np.where(left, counts - 2 * (bits @ bits[at]), np.inf)
        at = int(apart.argmin())
    return chain


def parents_of(edges: list[tuple[int, int, int]], cells: int, depth: int = MAX_DEPTH) -> NDArray[np.int32]:
    """Return (C,) int32, a parent for each cell; -1 for none.

    A cell shares many Gaussians with its parent, and no chain of parents is longer than `depth`. Trees grow from
    the cell that shares most with its neighbors. Each step adds the pair with most shared Gaussians that reaches a new
    cell.

    Args:
        edges: Pairs of neighbors (shared, a, b): how many Gaussians both see.
        cells: C.
        depth: Longest chain of parents.
    """
    beside = _beside(edges, cells)
    parents = np.full(cells, -1, np.int32)
    depths = np.full(cells, -1)
    strength = [sum(shared for shared, _ in pairs) for pairs in beside]
    for root in sorted(range(cells), key=lambda cell: (-strength[cell], cell)):
        if depths[root] < 0:
            depths[root] = 0
            _grow(root, beside, depth, parents, depths)
    return parents


def parents_in_groups(
    heads: NDArray[np.int32], within: list[tuple[int, int, int]], among: list[tuple[int, int, int]], cells: int
) -> NDArray[np.int32]:
    """Return (C,) int32, a parent for each cell; -1 for none. Cells of a group give a Gaussian the same class.

    So a cell with a parent of its own group needs classes for what that does not see alone. The heads of groups are
    connected first, then the other cells of each group to its head.

    Args:
        heads: (G,) a cell of each group.
        within: Pairs of cells of one group (shared, a, b): how many Gaussians both see.
        among: Pairs of groups (shared, a, b): how many Gaussians their heads give the same class.
        cells: C.
    """
    above = parents_of(among, len(heads), MAX_DEPTH - 1)
    parents = np.full(cells, -1, np.int32)
    parents[heads] = np.where(above >= 0, heads[above], -1)
    depths = np.full(cells, -1)
    depths[heads] = _depths_of(above)
    beside = _beside(within, cells)
    for head in heads.tolist():
        _grow(head, beside, MAX_DEPTH, parents, depths)
    return parents


def _beside(edges: list[tuple[int, int, int]], cells: int) -> list[list[tuple[int, int]]]:
    """Return the pairs (shared, other) of each cell that share something."""
    beside: list[list[tuple[int, int]]] = [[] for _ in range(cells)]
    for shared, a, b in edges:
        if shared > 0:
            beside[a].append((shared, b))
            beside[b].append((shared, a))
    return beside


def _grow(
    root: int,
    beside: list[list[tuple[int, int]]],
    most: int,
    parents: NDArray[np.int32],
    depths: NDArray[np.int64],
) -> None:
    """Add cells to the tree of a cell whose depth is known, the pair that shares most first.

    Args:
        root: The cell.
        beside: Pairs (shared, other) of each cell.
        most: Largest depth.
        parents: (C,) written.
        depths: (C,) written; below 0 for cells that are in no tree.
    """
    waiting = [(-shared, root, cell) for shared, cell in beside[root]]
    heapq.heapify(waiting)
    while waiting:
        _, parent, cell = heapq.heappop(waiting)
        if depths[cell] >= 0:
            continue
        parents[cell] = parent
        depths[cell] = depths[parent] + 1
        if depths[cell] < most:
            for shared, further in beside[cell]:
                if depths[further] < 0:
                    heapq.heappush(waiting, (-shared, cell, further))


def _depths_of(parents: NDArray[np.int32]) -> NDArray[np.int64]:
    """Return the number of parents above each cell."""
    depths = np.zeros(len(parents), np.int64)
    at = parents
    while (at >= 0).any():
        depths += at >= 0
        at = np.where(at >= 0, parents[at], -1)
    return depths
