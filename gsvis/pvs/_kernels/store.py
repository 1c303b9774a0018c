"""Kernels of the store: convert packed sets of Gaussians between stored order and scene order.

A set of N Gaussians is words of uint64: bit i % 64 of word i // 64 is position i, bits from N on are 0, and the words
fill whole roaring containers of 65,536 positions.
"""

from __future__ import annotations

import numpy as np

from gsvis._kernels.bits import lowest, ones
from gsvis._kernels.compiled import kernel
from gsvis._kernels.threads import in_parts

_CHUNK = 1024  # words of one roaring container: 65,536 positions
_ARRAY = 4096  # most positions of a container that lists them
_PART = 1024  # signatures that a thread compares at least
_BELOW = np.uint64(32)  # bits of the number of a center, below its number of differing bits
_NUMBER = np.uint64(2**32 - 1)
_MOST = np.uint64(2**64 - 1)


@kernel
def count_shared(left, right):
    """Return the number of positions that two sets share."""
    total = 0
    for w in range(len(left)):
        total += np.int64(ones(left[w] & right[w]))
    return total


@kernel
def positions(words, out):
    """Write the positions of the set bits, ascending; `out` has room for exactly these."""
    filled = 0
    for w in range(len(words)):
        word = words[w]
        while word:
            out[filled] = 64 * w + np.int64(lowest(word))
            filled += 1
            word &= word - np.uint64(1)


@kernel
def mark(ids, words):
    """Set the bits of ids."""
    for k in range(len(ids)):
        i = np.uint64(ids[k])
        words[i >> np.uint64(6)] |= np.uint64(1) << (i & np.uint64(63))


@kernel
def mark_some(ids, words, masks):
    """Write the non-empty words of a set of ascending ids, with room for all; return their number."""
    count = 0
    before = np.int64(-1)
    for k in range(len(ids)):
        w = np.int64(ids[k]) >> 6
        if w != before:
            words[count] = w
            masks[count] = 0
            before = w
            count += 1
        masks[count - 1] |= np.uint64(1) << np.uint64(ids[k] & 63)
    return count


@kernel
def scatter(words, order, out):
    """Set the bits order[i] in `out` for the positions i of a set."""
    for w in range(len(words)):
        word = words[w]
        while word:
            i = np.uint64(order[64 * w + np.int64(lowest(word))])
            out[i >> np.uint64(6)] |= np.uint64(1) << (i & np.uint64(63))
            word &= word - np.uint64(1)


@kernel
def scatter_from(words, order, first, out):
    """Set the bits first + order[i] in `out` for the positions i of a set."""
    start = np.uint64(first)
    for w in range(len(words)):
        word = words[w]
        while word:
            i = np.uint64(order[64 * w + np.int64(lowest(word))]) + start
            out[i >> np.uint64(6)] |= np.uint64(1) << (i & np.uint64(63))
            word &= word - np.uint64(1)


@kernel
def used(words, first, numbers, masks):
    """Write the non-empty words and their numbers, counted from `first`; return how many there are."""
    count = 0
    for w in range(len(words)):
        if words[w]:
            if count < len(masks):
                numbers[count], masks[count] = first + w, words[w]
            count += 1
    return count


@kernel
def scatter_levels(words, order, levels, out):
    """Write levels[i] at order[i] for the positions i of a set."""
    for w in range(len(words)):
        word = words[w]
        while word:
            i = 64 * w + np.int64(lowest(word))
            out[order[i]] = levels[i]
            word &= word - np.uint64(1)


@kernel
def shift_levels(words, order, common, shifts, run, classes, out):
    """Write 1 + the class at the positions of a set: that of the Gaussian order[i] plus the shift of its run."""
    for w in range(len(words)):
        word = words[w]
        while word:
            i = 64 * w + np.int64(lowest(word))
            g = np.int64(order[i])
            shifted = np.int64(common[g]) + np.int64(shifts[g // run])
            out[i] = 1 + min(max(shifted, 0), classes - 1)
            word &= word - np.uint64(1)


@kernel
def take_levels(words, levels, ids, out):
    """Write the positions of the set bits, ascending, and their levels less 1; with room for exactly these."""
    filled = 0
    for w in range(len(words)):
        word = words[w]
        while word:
            i = 64 * w + np.int64(lowest(word))
            ids[filled], out[filled] = i, levels[i] - np.uint8(1)
            filled += 1
            word &= word - np.uint64(1)


@kernel
def reach(words, waiting, alive, order, value, out):
    """Write `value` at order[i] for the positions i of a set that are waiting, and remove them from `waiting`.

    Args:
        words: The set.
        waiting: The set of waiting positions; changed.
        alive: (L,) int64, numbers of the non-zero words of `waiting`; those that remain non-zero move to the front.
        order: (N,) int32, the Gaussian at each position.
        value: The value to write.
        out: (N,) receives the value.

    Returns:
        Number of words of `waiting` that are still non-zero.
    """
    kept = 0
    for k in range(len(alive)):
        w = alive[k]
        fresh = words[w] & waiting[w]
        waiting[w] ^= fresh
        while fresh:
            out[order[64 * w + np.int64(lowest(fresh))]] = value
            fresh &= fresh - np.uint64(1)
        alive[kept] = w
        kept += waiting[w] != 0
    return kept


@kernel
def sort_labels(labels, order):
    """Write the places of labels (N,) uint16, sorted by label, then by place."""
    starts = np.zeros((1 << 16) + 1, np.int64)
    for i in range(len(labels)):
        starts[np.int64(labels[i]) + 1] += 1
    for k in range(1, len(starts)):
        starts[k] += starts[k - 1]
    for i in range(len(labels)):
        order[starts[labels[i]]] = i
        starts[labels[i]] += 1


@kernel
def add_signature(words, bit, signatures):
    """Set one bit in the signatures (N, W) of all positions of a set."""
    column = bit >> 6
    flag = np.uint64(1) << np.uint64(bit & 63)
    for w in range(len(words)):
        word = words[w]
        while word:
            signatures[64 * w + np.int64(lowest(word)), column] |= flag
            word &= word - np.uint64(1)


@in_parts(lambda signatures, *_: (len(signatures) + _PART - 1) // _PART)
@kernel
def nearest_centers(begin, end, signatures, columns, labels):
    """Write for each signature (M, W) the center with the fewest differing bits; the first of equal ones.

    `columns` (W, K) are the words of the centers, one row for each word, so that many are compared at a time.
    """
    words, centers = columns.shape
    keys = np.empty(centers, np.uint64)
    for i in range(_PART * begin, min(_PART * end, len(signatures))):
        for k in range(np.uint64(centers)):
            keys[k] = k
        for w in range(np.uint64(words)):
            word = signatures[i, w]
            column = columns[w]
            for k in range(np.uint64(centers)):
                keys[k] += ones(word ^ column[k]) << _BELOW
        least = _MOST
        for k in range(np.uint64(centers)):
            least = min(least, keys[k])
        labels[i] = least & _NUMBER


@kernel
def count_bits(signatures, labels, bits, sizes):
    """Add up, for each label, the signatures (sizes (K,)) and their set bits (bits (K, 64 W))."""
    for i in range(len(signatures)):
        k = labels[i]
        sizes[k] += 1
        for w in range(signatures.shape[1]):
            word = signatures[i, w]
            while word:
                bits[k, 64 * w + np.int64(lowest(word))] += 1
                word &= word - np.uint64(1)


@kernel
def count_contexts(words, parent, counts):
    """Add up how many positions of a set have each value in `parent`."""
    for w in range(len(words)):
        word = words[w]
        while word:
            counts[parent[64 * w + np.int64(lowest(word))]] += 1
            word &= word - np.uint64(1)


@kernel
def place_classes(words, parent, data, starts, digits, levels):
    """Give each position of a set the next symbol for its value in `parent`, plus 1.

    Args:
        words: The set.
        parent: (N,) uint8 value of each position.
        data: uint8, symbols as digits, several per byte.
        starts: First byte of the symbols of each value.
        digits: (256, D) uint8, the digits of each byte.
        levels: (N,) uint8, changed.
    """
    at = starts.copy()
    digit = np.zeros(len(starts), np.int64)
    for w in range(len(words)):
        word = words[w]
        while word:
            i = 64 * w + np.int64(lowest(word))
            context = parent[i]
            levels[i] = digits[data[at[context]], digit[context]] + np.uint8(1)
            digit[context] += 1
            if digit[context] == digits.shape[1]:
                at[context] += 1
                digit[context] = 0
            word &= word - np.uint64(1)


@kernel
def roaring(words, keys, cards, out):
    """Write the containers of the portable roaring format.

    Args:
        words: The set, whole containers of 1,024 words.
        keys: (containers,) int64, receives the numbers of the containers that are not empty.
        cards: (containers,) int64, receives their counts.
        out: uint16, receives their contents.

    Returns:
        Number of containers that are not empty, and number of uint16 written.
    """
    found = 0
    end = 0
    for chunk in range(len(words) // _CHUNK):
        start = chunk * _CHUNK
        total = 0
        for w in range(start, start + _CHUNK):
            total += np.int64(ones(words[w]))
        if total == 0:
            continue
        keys[found] = chunk
        cards[found] = total
        found += 1
        if total > _ARRAY:
            for w in range(start, start + _CHUNK):
                word = words[w]
                for part in range(4):
                    out[end] = np.uint16(word >> np.uint64(16 * part))
                    end += 1
            continue
        for w in range(start, start + _CHUNK):
            word = words[w]
            while word:
                out[end] = np.uint16(64 * (w - start) + np.int64(lowest(word)))
                end += 1
                word &= word - np.uint64(1)
    return found, end
