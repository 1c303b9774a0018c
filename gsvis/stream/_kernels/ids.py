"""Kernels of the wire: encode ascending ids as differences in exponential Golomb codes, sort ids, group terms by owner.

Arrays are checked and contiguous, sets are packed words. Bits are written from the lowest of each byte up. The code of
order k of a value v: w = v + 2^k has n bits. Write n - k - 1 zeros, a one, and the lower n - 1 bits of w, lowest first.
"""

from __future__ import annotations

import numpy as np

from gsvis._kernels.bits import lowest
from gsvis._kernels.compiled import kernel, njit

MOST_ORDER = 24  # highest order of a code
_NEAR = 4  # next chunks to try before the chunk of an id is looked up
MOST_BITS = 2 * 33  # most bits of a value below 2^32, in any order


@njit(inline="always")
def _length(value):
    """Return the number of bits of an integer in [1, 2^52)."""
    return (np.float64(value).view(np.int64) >> 52) - 1022


@kernel
def distances(ids, out):
    """Write the difference of each ascending id from the one before, minus 1; for the first, the id itself."""
    before = np.int64(-1)
    for i in range(len(ids)):
        out[i] = np.int64(ids[i]) - before - 1
        before = np.int64(ids[i])


@kernel
def owner_distances(terms, owners, share, out):
    """Write the zigzag-encoded error of predicting each owner from the one before and the difference of their terms.

    Args:
        terms: (M,) ids of terms, ascending.
        owners: (M,) the Gaussian of each term, never decreasing.
        share: Gaussians for each term of the scene, times 2^16.
        out: (M,) int64, receives the values.
    """
    term = np.int64(0)
    owner = np.int64(0)
    for i in range(len(terms)):
        to = np.int64(terms[i])
        of = np.int64(owners[i])
        rest = of - owner - ((to - term) * share >> 16)
        out[i] = 2 * rest if rest >= 0 else -2 * rest - 1
        term = to
        owner = of


@kernel
def best_order(values):
    """Return the order of the code in which values take the fewest bits."""
    lengths = np.zeros(64, np.int64)
    longest = 1
    for i in range(len(values)):
        n = _length(values[i] + 1)
        lengths[n] += 1
        longest = max(longest, n)
    best = 0
    least = np.int64(1) << 62
    for k in range(min(longest, MOST_ORDER + 1)):
        total = np.int64(0)
        for n in range(1, longest + 1):
            total += lengths[n] * (k + 1 + 2 * max(n - 1 - k, 0))
        if total < least:
            best = k
            least = total
    return best


@kernel
def write_ids(chunks, gaussians, terms, owners, gone, evicted, share, orders, out):
    """Write the six lists of ids of a batch as bits.

    Args:
        chunks: (C,) int64 first ids of chunks, ascending.
        gaussians: (G,) int32 ids of Gaussians, ascending.
        terms: (M,) uint32 ids of terms, ascending.
        owners: (M,) int32, the Gaussian of each term, never decreasing.
        gone: (D,) int32 ids of replaced Gaussians, ascending.
        evicted: (E,) int32 ids of evicted Gaussians, ascending.
        share: Gaussians for each term of the scene, times 2^16.
        orders: (6,) uint8, receives the order of the code of each list.
        out: uint8, receives the bits; long enough for all of them.

    Returns:
        Number of bits.
    """
    values = np.empty(max(len(chunks), len(gaussians), len(terms), len(gone), len(evicted)), np.int64)
    bit = np.int64(0)
    for k in range(6):
        if k == 0:
            some = values[: len(chunks)]
            distances(chunks, some)
        elif k == 1:
            some = values[: len(gaussians)]
            distances(gaussians, some)
        elif k == 2:
            some = values[: len(terms)]
            distances(terms, some)
        elif k == 3:
            some = values[: len(terms)]
            owner_distances(terms, owners, share, some)
        elif k == 4:
            some = values[: len(gone)]
            distances(gone, some)
        else:
            some = values[: len(evicted)]
            distances(evicted, some)
        order = best_order(some)
        orders[k] = order
        bit = write(some, order, out, bit)
    return bit


@kernel
def write(values, order, out, bit):
    """Append values to a string of bits; those from `bit` to the end of its byte must be zero.

    Returns:
        The bit after the last; the rest of its byte is zero.
    """
    byte = bit >> 3
    filled = bit & 7
    word = np.uint64(out[byte]) if filled else np.uint64(0)
    one = np.uint64(1)
    for i in range(len(values)):
        w = np.uint64(values[i]) + (one << np.uint64(order))
        n = _length(np.int64(w))
        zeros = n - order - 1
        if zeros + n > 32:  # rare: write the bits so far first, to make room
            while filled >= 8:
                byte = _write_byte(out, byte, word)
                word = word >> np.uint64(8)
                filled = filled - 8
            filled += zeros
            zeros = 0
            while filled >= 8:
                byte = _write_byte(out, byte, word)
                word = word >> np.uint64(8)
                filled = filled - 8
        word |= (((w & ((one << np.uint64(n - 1)) - one)) << one) | one) << np.uint64(filled + zeros)
        filled += zeros + n
        while filled >= 32:
            for _ in range(4):
                byte = _write_byte(out, byte, word)
                word = word >> np.uint64(8)
            filled -= 32
    while filled > 0:
        byte = _write_byte(out, byte, word)
        word = word >> np.uint64(8)
        filled = filled - 8
    return 8 * byte + filled


@njit(inline="always")
def _write_byte(out, byte, word):
    """Write the low 8 bits of `word` at place `byte`; return the next place."""
    out[byte] = np.uint8(word & np.uint64(255))
    return byte + 1


@kernel
def read(data, bit, order, values):
    """Decode values of an order from `bit` on until the array is full; return the next bit, or -1 for invalid bits."""
    end = 8 * len(data)
    for i in range(len(values)):
        zeros = 0
        while bit < end and not (data[bit >> 3] >> np.uint8(bit & 7)) & 1:
            zeros += 1
            bit += 1
        count = order + zeros
        bit += 1
        if zeros > 32 or count > 33 or bit + count > end:
            return np.int64(-1)
        w = np.uint64(0)
        got = 0
        while got < count:
            take = min(8 - (bit & 7), count - got)
            part = (np.uint64(data[bit >> 3]) >> np.uint64(bit & 7)) & (
                (np.uint64(1) << np.uint64(take)) - np.uint64(1)
            )
            w |= part << np.uint64(got)
            got += take
            bit += take
        values[i] = np.int64(w | (np.uint64(1) << np.uint64(count))) - (np.int64(1) << order)
    return np.int64(bit)


@kernel
def ids_from(values, limit, out):
    """Decode ids from their `distances`; return whether all are below the limit."""
    at = np.int64(-1)
    for i in range(len(values)):
        at += values[i] + 1
        if at >= limit:
            return False
        out[i] = at
    return True


@kernel
def owners_from(values, terms, share, gaussians, out):
    """Decode owners from their `owner_distances`; return whether none decreases or reaches `gaussians`."""
    term = np.int64(0)
    owner = np.int64(0)
    for i in range(len(values)):
        rest = values[i] >> 1 if values[i] & 1 == 0 else -((values[i] + 1) >> 1)
        found = owner + ((terms[i] - term) * share >> 16) + rest
        if found < owner or found >= gaussians:
            return False
        term = terms[i]
        owner = found
        out[i] = found
    return True


@kernel
def ascend(ids, marks, summary, out):
    """Write ids (M,), all different, to `out` in ascending order.

    Args:
        ids: (M,).
        marks: (W,) uint64 scratch, a bit for each id; zeros before and after the call.
        summary: (W / 64,) uint64 scratch, a bit for each word of `marks`; zeros before and after the call.
        out: (M,) receives the ids.
    """
    count = 0
    one = np.uint64(1)
    low = np.int64(len(summary))
    high = np.int64(-1)
    for i in range(len(ids)):
        w = np.int64(ids[i]) >> 6
        marks[w] |= one << np.uint64(ids[i] & 63)
        summary[w >> 6] |= one << np.uint64(w & 63)
        low = min(low, w >> 6)
        high = max(high, w >> 6)
    for v in range(low, high + 1):  # in a large scene the ids are in few tiles
        some = summary[v]
        summary[v] = 0
        while some:
            w = 64 * v + np.int64(lowest(some))
            some &= some - one
            rest = marks[w]
            marks[w] = 0
            while rest:
                out[count] = 64 * w + np.int64(lowest(rest))
                rest &= rest - one
                count += 1


@kernel
def lay_out(ids, of, starts, known, rows, fresh):
    """Find the chunks of ascending ids, and mark them as known.

    Args:
        ids: (G,) int32 ids of Gaussians.
        of: (N,) int32, the chunk of each Gaussian.
        starts: (C + 1,) first id of each chunk, and N.
        known: (C,) bool, whether the client has the row of each chunk; updated.
        rows: (G,) int32, receives the chunk of each id.
        fresh: (min(G, C),) or longer, receives the chunks that were not known, ascending.

    Returns:
        Number of chunks that were not known.
    """
    found = 0
    end = np.int64(0)
    row = np.int64(-1)
    for i in range(len(ids)):
        g = np.int64(ids[i])
        if g >= end:
            last = row + _NEAR
            while row < last and g >= end:  # most chunks follow each other, and `starts` stays in the cache
                row += 1
                end = np.int64(starts[row + 1])
            if g >= end:
                row = np.int64(of[g])
                end = np.int64(starts[row + 1])
            if not known[row]:
                known[row] = True
                fresh[found] = row
                found += 1
        rows[i] = row
    return found


@kernel
def group_terms(owners, slots, terms, offsets, out):
    """Group terms by the slot of their Gaussian, within a slot in the order of their arrival.

    Args:
        owners: (M,) Gaussian of each term.
        slots: (N,) slot of each Gaussian, from 1; terms of Gaussians with slot 0 are left out.
        terms: (functions (M,), centers (M, 2), decays (M,), intensities (M, I)).
        offsets: (n + 1,) int64 zeros, receives where the terms of each slot begin.
        out: Arrays like `terms`, receive the grouped terms.

    Returns:
        Number of terms in `out`.
    """
    n = len(offsets) - 1
    for i in range(len(owners)):
        slot = slots[owners[i]] - 1
        if slot >= 0:
            offsets[slot + 1] += 1
    for k in range(n):
        offsets[k + 1] += offsets[k]
    total = offsets[n]
    functions, centers, decays, intensities = terms
    to_functions, to_centers, to_decays, to_intensities = out
    for i in range(len(owners)):
        slot = slots[owners[i]] - 1
        if slot >= 0:
            place = offsets[slot]
            offsets[slot] = place + 1
            to_functions[place] = functions[i]
            to_decays[place] = decays[i]
            to_centers[place, 0] = centers[i, 0]
            to_centers[place, 1] = centers[i, 1]
            for k in range(intensities.shape[1]):
                to_intensities[place, k] = intensities[i, k]
    for k in range(n, 0, -1):
        offsets[k] = offsets[k - 1]
    offsets[0] = 0
    return total
