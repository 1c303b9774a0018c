"""Keys of the Gaussians that a square waits for, and their order: nearest first, ties by row.

A key is a uint64: the bits of the squared distance, the power of two of specks for which the Gaussian stands, its row.
"""

from __future__ import annotations

import numpy as np

from gsvis._kernels.compiled import inner, uncounted

__all__ = ["BELOW", "PLACES", "STANDS", "row_of", "sort_keys"]

BELOW = np.uint64(32)
"""Bits of a key below its distance."""
STANDS = np.uint64(29)
"""Bits of a key below the power of two."""
PLACES = 512
"""Places for keys by distance."""
_ROW = np.uint64(2**29 - 1)
_RUN = 12  # length of runs of keys that are sorted by insertion
_MOVES = 8  # most moves by insertion for each key, on average
_NONE = np.uint64(0)


@inner
def row_of(key):
    """Return the row of a key."""
    return np.int64(key & _ROW)


@uncounted
def _merge(keys, out, width, count):
    """Merge neighboring sorted runs of `width` keys, two and two."""
    for left in range(0, count, 2 * width):
        middle = min(left + width, count)
        right = min(left + 2 * width, count)
        i = left
        j = middle
        for k in range(left, right):
            if j >= right or (i < middle and keys[i] <= keys[j]):
                out[k] = keys[i]
                i += 1
            else:
                out[k] = keys[j]
                j += 1


@uncounted
def _sort_by_merging(keys, room, count):
    """Sort the first `count` keys ascending; return whether `room` holds them, not `keys`."""
    for start in range(0, count, _RUN):
        for i in range(start + 1, min(start + _RUN, count)):
            key = keys[i]
            k = i
            while k > start and keys[k - 1] > key:
                keys[k] = keys[k - 1]
                k -= 1
            keys[k] = key
    width = _RUN
    moved = False
    while width < count:
        if moved:
            _merge(room, keys, width, count)
        else:
            _merge(keys, room, width, count)
        moved = not moved
        width *= 2
    return moved


@uncounted
def _place_by_distance(keys, room, tally, count):
    """Write the first `count` keys to `room`, nearly in order: by the leading bits in which their distances differ."""
    low = keys[0]
    high = keys[0]
    for k in range(np.uint64(count)):
        low = min(low, keys[k])
        high = max(high, keys[k])
    first = low >> BELOW
    span = (high >> BELOW) - first
    shift = _NONE
    while span >> shift >= np.uint64(PLACES):
        shift += np.uint64(1)
    for k in range(np.uint64(PLACES + 1)):
        tally[k] = 0
    for k in range(np.uint64(count)):
        tally[(((keys[k] >> BELOW) - first) >> shift) + np.uint64(1)] += 1
    for k in range(np.uint64(PLACES)):
        tally[k + np.uint64(1)] += tally[k]
    for k in range(np.uint64(count)):
        place = ((keys[k] >> BELOW) - first) >> shift
        room[np.uint64(tally[place])] = keys[k]
        tally[place] += 1


@uncounted
def sort_keys(keys, room, tally, count):
    """Sort the first `count` keys ascending; return whether `room` holds them, not `keys`.

    Keys are placed by distance and then moved by insertion. Where many lie close together, they are merged instead.
    """
    if count < _RUN:
        return _sort_by_merging(keys, room, count)
    _place_by_distance(keys, room, tally, count)
    left = np.int64(_MOVES) * count
    for i in range(np.int64(1), count):
        key = room[np.uint64(i)]
        k = i
        while k > 0 and room[np.uint64(k - 1)] > key:
            room[np.uint64(k)] = room[np.uint64(k - 1)]
            k -= 1
        room[np.uint64(k)] = key
        left -= i - k
        if left < 0:
            return not _sort_by_merging(room, keys, count)
    return True
