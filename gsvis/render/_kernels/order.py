"""Kernels that sort splats front to back: a radix sort by depth, then runs of equal depth by content.

A splat travels as one number: its depth's bits over its index. Depths are positive, so they are ordered like their
bits. Threads take blocks of fixed size as they come free: the order does not depend on the number of threads.
"""

from __future__ import annotations

import numpy as np

from gsvis._kernels.compiled import inner, kernel, njit, uncounted
from gsvis._kernels.shared import share, take_next
from gsvis._kernels.threads import in_threads, on_numba_threads

BLOCK = 1 << 13  # splats that one thread takes at a time
DIGIT = 11  # most bits sorted by in one pass
_SHORT = 32  # longest run that is sorted by insertion


@inner
def _join_block(block, bits, least, out):
    """Write the keys of one block; see `join_keys`."""
    for m in range(block * BLOCK, min(len(bits), (block + 1) * BLOCK)):
        out[m] = (np.uint64(bits[m] - least) << np.uint64(32)) | np.uint64(m)


@on_numba_threads
@kernel
def join_keys(bits, least, out):
    """Write keys into out (M,) uint64: bits (M,) uint32 minus the least of them, then the index."""
    share(_join_block, (len(bits) + BLOCK - 1) // BLOCK, (bits, least, out))


@inner
def _count_block(block, keys, shift, counts):
    """Count the digits of one block; see `count_digits`."""
    mask = np.uint64(counts.shape[1] - 1)
    for k in range(block * BLOCK, min(len(keys), (block + 1) * BLOCK)):
        counts[block, np.int64((keys[k] >> shift) & mask)] += 1


@on_numba_threads
@kernel
def count_digits(keys, shift, counts):
    """Count the digits above bit `shift` of the keys of each block into counts (blocks, digits)."""
    share(_count_block, len(counts), (keys, shift, counts))


@njit(cache=True)
def place_blocks(counts, ends):
    """Turn counts (blocks, groups) into first places, group by group; ends (groups,) receives where each group ends."""
    total = 0
    for group in range(counts.shape[1]):
        for block in range(len(counts)):
            count = counts[block, group]
            counts[block, group] = total
            total += count
        ends[group] = total


@inner
def _move_block(block, keys, shift, places, out):
    """Move the keys of one block; see `move_keys`."""
    mask = np.uint64(places.shape[1] - 1)
    for k in range(block * BLOCK, min(len(keys), (block + 1) * BLOCK)):
        digit = np.int64((keys[k] >> shift) & mask)
        out[places[block, digit]] = keys[k]
        places[block, digit] += 1


@on_numba_threads
@kernel
def move_keys(keys, shift, places, out):
    """Move keys to their places (blocks, digits), which are counted up; equal digits keep their order."""
    share(_move_block, len(places), (keys, shift, places, out))


@uncounted
def _row_order(rows, i, j):
    """Return -1, 0 or 1 if row i of an array sorts before, with or after row j."""
    for c in range(rows.shape[1]):
        if rows[i, c] != rows[j, c]:
            return -1 if rows[i, c] < rows[j, c] else 1
    return 0


@uncounted
def _less(i, j, ids, means, rest):
    """Return whether splat i sorts before splat j of equal depth: by mean, then by the rest of its content."""
    i = ids[i]
    j = ids[j]
    sign = _row_order(means, i, j)
    if sign != 0:
        return sign < 0
    for rows in rest:
        sign = _row_order(rows, i, j)
        if sign != 0:
            return sign < 0
    return False


@uncounted
def _sort_short(order, start, stop, ids, means, rest, near, first):
    """Sort a short run by insertion; near[k - first] is a copy of the mean of order[k]."""
    for k in range(start + 1, stop):
        m = order[k]
        x = near[k - first, 0]
        y = near[k - first, 1]
        z = near[k - first, 2]
        at = k
        while at > start:
            u = near[at - 1 - first, 0]
            v = near[at - 1 - first, 1]
            w = near[at - 1 - first, 2]
            if x != u:
                before = x < u
            elif y != v:
                before = y < v
            elif z != w:
                before = z < w
            else:
                before = _less(m, order[at - 1], ids, means, rest)
            if not before:
                break
            near[at - first, 0] = u
            near[at - first, 1] = v
            near[at - first, 2] = w
            order[at] = order[at - 1]
            at -= 1
        near[at - first, 0] = x
        near[at - first, 1] = y
        near[at - first, 2] = z
        order[at] = m


@uncounted
def _merge_runs(order, start, stop, ids, means, rest, width, scratch):
    """Merge neighboring sorted runs of `width` splats, two and two, in place; scratch is (stop - start,)."""
    for left in range(start, stop, 2 * width):
        middle = min(left + width, stop)
        right = min(left + 2 * width, stop)
        i = left
        j = middle
        for k in range(left, right):
            take_left = i < middle
            if take_left and j < right:
                take_left = not _less(order[j], order[i], ids, means, rest)
            if take_left:
                scratch[k - start] = order[i]
                i += 1
            else:
                scratch[k - start] = order[j]
                j += 1
        for k in range(left, right):
            order[k] = scratch[k - start]


@inner
def _sort_long(order, start, stop, ids, means, rest):
    """Sort a run by merging."""
    scratch = np.empty(stop - start, order.dtype)
    width = 1
    while width < stop - start:
        _merge_runs(order, start, stop, ids, means, rest, width, scratch)
        width *= 2


@uncounted
def _unpack(keys, first, last, ids, means, order, near):
    """Write the splats of keys first..last into `order`, and copies of the means of those of equal depth."""
    depth = np.uint64(32)
    index = np.uint64(0xFFFFFFFF)
    tied = False
    for k in range(first, last):  # apart from the sorting: here no load waits for a comparison
        order[k] = np.int32(keys[k] & index)
        follows = tied
        tied = k + 1 < last and keys[k] >> depth == keys[k + 1] >> depth
        if (follows or tied) and k - first < len(near):
            i = ids[order[k]]
            near[k - first, 0], near[k - first, 1], near[k - first, 2] = means[i, 0], means[i, 1], means[i, 2]


@in_threads(lambda keys, *_: (len(keys) + BLOCK - 1) // BLOCK)
@kernel(error_model="numpy")
def order_ties(taken, keys, ids, means, scales, quats, opacities, sh0, order):
    """Write the splats of sorted keys into order (M,), runs of equal depth by content, and equal content by index.

    All content is (N, columns). A run belongs to the block in which it begins.
    """
    rest = (scales, quats, opacities, sh0)
    depth = np.uint64(32)
    blocks = (len(keys) + BLOCK - 1) // BLOCK
    block = take_next(taken)
    near = np.empty((BLOCK + _SHORT if block < blocks else 0, 3), np.float32)
    while block < blocks:
        first = block * BLOCK
        last = min(len(keys), (block + 1) * BLOCK)
        while 0 < first < last and keys[first] >> depth == keys[first - 1] >> depth:
            first += 1
        while first < last < len(keys) and keys[last] >> depth == keys[last - 1] >> depth:
            last += 1
        _unpack(keys, first, last, ids, means, order, near)
        start = first
        while start < last:
            stop = start + 1
            while stop < last and keys[stop] >> depth == keys[start] >> depth:
                stop += 1
            if stop - start > _SHORT:
                _sort_long(order, start, stop, ids, means, rest)
            elif stop - start > 1:
                _sort_short(order, start, stop, ids, means, rest, near, first)
            start = stop
        block = take_next(taken)
