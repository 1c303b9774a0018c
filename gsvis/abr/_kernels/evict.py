"""Kernels that evict Gaussians from what a client holds, and count the bytes of what it holds."""

from __future__ import annotations

import numpy as np

from gsvis._kernels.bits import has, lowest
from gsvis._kernels.compiled import kernel, njit


@njit(inline="always")
def _remove(words, i):
    """Remove an id from a packed set."""
    words[i >> 6] &= ~(np.uint64(1) << np.uint64(i & 63))


@kernel(error_model="numpy")
def held_terms_of(ids, held_terms, term_offsets):
    """Return how many terms of Gaussians (M,) are held."""
    count = 0
    for i in range(len(ids)):
        for t in range(term_offsets[ids[i]], term_offsets[ids[i] + 1]):
            count += 1 if has(held_terms, t) else 0
    return count


@kernel(error_model="numpy")
def evict(words, masks, needed, sizes, held, term_offsets, links, out):
    """Remove Gaussians and their terms from what is held, until enough bytes are free.

    The Gaussians that an evicted one had replaced are no longer gone: they can be sent again.

    Args:
        words: (M,) numbers of words, in the order in which their Gaussians are evicted.
        masks: (M,) uint64, the Gaussians of each word that may be evicted; all are held and not gone.
        needed: Bytes to free.
        sizes: Bytes of a Gaussian, and of a term.
        held: `Held`; changed.
        term_offsets: (N + 1,).
        links: `Links`.
        out: (N,) int32, receives the ids.

    Returns:
        Number of ids, and the bytes that are free now.
    """
    gaussians, held_terms, gone = held
    offsets = links.offsets
    ranks = links.ranks
    ending = links.ending
    count = 0
    done = 0
    freed = 0.0
    one = np.uint64(1)
    for m in range(len(words)):
        w = np.int64(words[m])
        rest = masks[m]
        while rest:
            if freed >= needed:
                return count, freed
            first = 64 * w + np.int64(lowest(rest))
            rest &= rest - one
            freed += sizes[0]
            out[count] = first
            count += 1
            while done < count:
                g = np.int64(out[done])
                done += 1
                _remove(gaussians, g)
                _remove(gone, g)
                for t in range(term_offsets[g], term_offsets[g + 1]):
                    if has(held_terms, t):
                        _remove(held_terms, t)
                        freed += sizes[1] if g == first else 0.0  # terms of replaced Gaussians were freed before
                for k in range(offsets[g], offsets[g + 1]):
                    x = ending[ranks[k]]
                    if has(gone, x):
                        _remove(gone, x)
                        out[count] = x
                        count += 1
    return count, freed


@kernel(error_model="numpy")
def owe_again(words, evicted, owed, checked):
    """Add evicted Gaussians, a packed set (W,), to `owed` (S,) or (0,), and remove them from `checked` (K, S)."""
    for s in range(len(owed)):
        bits = evicted[words[s]]
        owed[s] |= bits
        for k in range(len(checked)):
            checked[k, s] &= ~bits
