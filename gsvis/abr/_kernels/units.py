"""Kernels that make the units of a cell: sets of up to 64 Gaussians that are ranked together.

Sets are packed words (see `gsvis._kernels.bits`). A unit is a word with a mask: members of one weight class
and one code, (ring L + first level) L + last level. A bucket is a gain rounded to 32 steps for each halving, 0 is the
largest.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from gsvis._kernels.bits import lowest, ones
from gsvis._kernels.compiled import kernel, njit

BUCKETS = 1024
LEAST = 129 * 32 - (BUCKETS - 1)  # a gain of 4, the largest there is: its float32 without the last 18 bits
# kinds of records: a Gaussian, its terms; kinds from `STRONG` on are terms that change the image much
GEOMETRY = 0
TERMS = 1
STRONG = 2
# parts of the view
INSIDE = 0
OUTSIDE = 1
EDGE = 2


class Units(NamedTuple):
    """U units, the rows of `Candidates`."""

    slots: Any  # (U,) int32, index of the word of each unit in `Candidates.words`
    masks: Any  # (U,) uint64, its Gaussians in the word
    areas: Any  # (U,) float32, mean of weight times area per byte
    pixels: Any  # (U,) float32, mean of weight times the area that a pixel adds at distance 1, per byte
    codes: Any  # (U,) uint16, (ring L + first level) L + last level
    logs: Any  # (U,) float32, logarithm of the blending weight of its class


class Runs(NamedTuple):
    """R runs of units of one ring and word."""

    starts: Any  # (R + 1,) int32, first unit of each run, and U
    slots: Any  # (R,) int32, slot of each run


class Seen(NamedTuple):
    """A packed set without its empty words."""

    words: Any  # (S,) int32 ascending, number of each word
    masks: Any  # (S,) uint64, its members


class Traits(NamedTuple):
    """Strengths and levels of N Gaussians in W words."""

    strengths: Any  # (N, 2) float32, see `gsvis.abr.words.strengths`
    pairs: Any  # (N,) uint16, first level L + last level
    mixed: Any  # (W,) whether a word has more than one pair


@njit(inline="always")
def bucket_of(gain):
    """Return the bucket of a gain >= 0, which is weighted solid angle per byte."""
    place = (np.float32(gain).view(np.int32) >> np.int32(18)) - np.int32(LEAST)  # 32 bits, for SIMD lanes
    return np.int32(BUCKETS - 1) - min(max(place, np.int32(0)), np.int32(BUCKETS - 1))


@kernel(error_model="numpy")
def word_spheres(means, radii, areas, spheres, spreads):
    """Compute a sphere around the Gaussians of each word, and their mean squared distance from its center.

    Args:
        means: (N, 3).
        radii: (N,).
        areas: (N,), weights of the center.
        spheres: (W, 4) receives center and radius.
        spreads: (W,) receives the squares.
    """
    n = len(means)
    for w in range(-(-n // 64)):
        low = 64 * w
        high = min(64 * w + 64, n)
        x = 0.0
        y = 0.0
        z = 0.0
        total = 0.0
        for g in range(low, high):
            share = min(np.float64(areas[g]), 1e12) + 1e-12
            x = x + share * means[g, 0]
            y = y + share * means[g, 1]
            z = z + share * means[g, 2]
            total += share
        x = x / total
        y = y / total
        z = z / total
        reach = 0.0
        spread = 0.0
        for g in range(low, high):
            a = means[g, 0] - x
            b = means[g, 1] - y
            c = means[g, 2] - z
            square = a * a + b * b + c * c
            share = min(np.float64(areas[g]), 1e12) + 1e-12
            spread += share * square
            reach = max(reach, np.sqrt(square) + radii[g])
        spheres[w, 0] = x
        spheres[w, 1] = y
        spheres[w, 2] = z
        slack = 1e-6 * (reach + abs(x) + abs(y) + abs(z)) + 1e-30  # bounds the rounding of depths
        spheres[w, 3] = min(reach + slack, 1e30)
        spreads[w] = min(spread / total, 1e30)


@njit(inline="always")
def _levels_of(pairs, levels, stands, g):
    """Return first level L + last level of a Gaussian; its last level is the highest if its bit in `stands` is set."""
    if (stands >> np.uint64(g & 63)) & np.uint64(1):
        return pairs[g] // levels * levels + levels - 1
    return np.int64(pairs[g])


@kernel(error_model="numpy")
def cell_units(seen, classes, traits, class_weights, standing, levels, found):
    """Split the members of a cell into units of ring 0.

    Args:
        seen: `Seen`, the members.
        classes: (V,) weight class of each, in rising order of ids.
        traits: `Traits`.
        class_weights: (K,).
        standing: (S,) uint64, the members that the cell sees at all levels above their last; (0,) for none.
        levels: L, number of levels.
        found: `Units`, receives the units; `slots` receives numbers of words.

    Returns:
        Number of units.
    """
    strengths, pairs, mixed = traits
    out_words, out_masks, out_areas, out_pixels, out_codes, out_logs = found
    one = np.uint64(1)
    masks = np.zeros(256, np.uint64)
    sums = np.zeros((256, 2))
    rank = 0
    filled = 0
    words = seen.words
    members = seen.masks
    for s in range(len(words)):
        w = np.int64(words[s])
        rest = members[s]
        stands = standing[s] if len(standing) else np.uint64(0)
        low_class = 255
        high_class = 0
        while rest:
            low = lowest(rest)
            rest &= rest - one
            kind = np.int64(classes[rank])
            g = 64 * w + np.int64(low)
            rank += 1
            masks[kind] |= one << low
            sums[kind, 0] += strengths[g, 0]
            sums[kind, 1] += strengths[g, 1]
            low_class = min(low_class, kind)
            high_class = max(high_class, kind)
        for kind in range(low_class, high_class + 1):
            whole = masks[kind]
            area = sums[kind, 0]
            pixel = sums[kind, 1]
            masks[kind] = 0
            sums[kind, 0] = 0.0
            sums[kind, 1] = 0.0
            while whole:
                lead = 64 * w + np.int64(lowest(whole))
                mask = whole
                pair = _levels_of(pairs, levels, stands, lead)
                if mixed[w] or stands:
                    rest = whole
                    mask = np.uint64(0)
                    area = 0.0
                    pixel = 0.0
                    while rest:
                        low = lowest(rest)
                        rest &= rest - one
                        g = 64 * w + np.int64(low)
                        if _levels_of(pairs, levels, stands, g) == pair:
                            mask |= one << low
                            area += strengths[g, 0]
                            pixel += strengths[g, 1]
                whole &= ~mask
                count = np.float64(ones(mask))
                out_words[filled] = w
                out_masks[filled] = mask
                out_codes[filled] = pair
                out_areas[filled] = class_weights[kind] * area / count
                out_pixels[filled] = class_weights[kind] * pixel / count
                out_logs[filled] = np.log(max(class_weights[kind], 1e-30))
                filled += 1
    return filled


@kernel
def add_fresh(seen, before, fresh, listed, count):
    """Add the members of `seen` that are not in `before` (W,) to `fresh` (W,).

    The numbers of words that become nonempty are appended to `listed`, which has `count` of them; return the new count.
    """
    words, masks = seen
    for s in range(len(words)):
        w = words[s]
        rest = masks[s] & ~before[w]
        if rest:
            if not fresh[w]:
                listed[count] = w
                count += 1
            fresh[w] |= rest
    return count


@kernel
def settle(words, fresh, before, masks, listed, count):
    """Move words (S,) of `fresh` (W,) to `masks` (S,), and add them to `before` (W,).

    The numbers of words that were empty in `before` are appended to `listed`, which has `count` of them; return the new
    count.
    """
    for s in range(len(words)):
        w = words[s]
        masks[s] = fresh[w]
        fresh[w] = 0
        if not before[w]:
            listed[count] = w
            count += 1
        before[w] |= masks[s]
    return count


@kernel
def take_out(words, packed, masks):
    """Move words (S,) of a packed set (W,) to `masks` (S,)."""
    for s in range(len(words)):
        masks[s] = packed[words[s]]
        packed[words[s]] = 0


@kernel
def add(seen, packed):
    """Add a `Seen` set to a packed set (W,)."""
    words, masks = seen
    for s in range(len(words)):
        packed[words[s]] |= masks[s]


@kernel
def put_in(words, masks, packed):
    """Write masks (S,) of words (S,) to a packed set (W,)."""
    for s in range(len(words)):
        packed[words[s]] = masks[s]


@kernel
def find_masks(words, seen, out):
    """Write the masks of a `Seen` set for words (S,), ascending, to `out` (S,), which holds zeros."""
    seen_words, masks = seen
    s = 0
    for k in range(len(seen_words)):
        while s < len(words) and words[s] < seen_words[k]:
            s += 1
        if s < len(words) and words[s] == seen_words[k]:
            out[s] = masks[k]


@kernel
def slots_in(words, unit_words, out):
    """Write the slot of each unit: the index of its word in `words` (S,), ascending.

    Args:
        words: (S,) numbers of words.
        unit_words: (U,) number of the word of each unit, ascending within a ring.
        out: (U,) receives the slots.
    """
    s = 0
    for u in range(len(unit_words)):
        if u and unit_words[u] < unit_words[u - 1]:
            s = 0
        while words[s] < unit_words[u]:
            s += 1
        out[u] = s


@kernel(error_model="numpy")
def ring_units(fresh, starts, every, found):
    """Write the units of the Gaussians in `fresh`, and return their number.

    Args:
        fresh: `Seen`.
        starts: (W + 1,) first unit of each word in `every`.
        every: `Units` of all Gaussians.
        found: `Units`, receives the units; `slots` receives numbers of words.
    """
    _, masks, areas, pixels, codes, logs = every
    out_words, out_masks, out_areas, out_pixels, out_codes, out_logs = found
    words = fresh.words
    wanted = fresh.masks
    filled = 0
    for s in range(len(words)):
        w = words[s]
        for u in range(starts[w], starts[w + 1]):
            mask = masks[u] & wanted[s]
            if mask:
                out_words[filled], out_masks[filled], out_codes[filled] = w, mask, codes[u]
                out_areas[filled], out_pixels[filled], out_logs[filled] = areas[u], pixels[u], logs[u]
                filled += 1
    return filled


@kernel(error_model="numpy")
def pair_bytes(words, masks, codes, word_bytes, sums):
    """Add to `sums` (L * L,) the bytes of units (U,), by first and last level; `word_bytes` (W,) are means a word."""
    for u in range(len(words)):
        sums[codes[u]] += np.float64(ones(masks[u])) * word_bytes[words[u]]


@njit(inline="always")
def _touches(planes, x, y, z, radius):
    """Return 2 where a sphere is inside one of the frusta, 1 where it touches one, else 0."""
    best = 0
    for f in range(planes.shape[0]):
        whole = True
        part = True
        for k in range(planes.shape[1]):
            far = planes[f, k, 0] * x + planes[f, k, 1] * y + planes[f, k, 2] * z + planes[f, k, 3]
            if far + radius < 0.0:
                part = False
                break
            whole &= far >= radius
        if part:
            best = max(best, 2 if whole else 1)
    return best


@kernel(error_model="numpy")
def in_view(planes, means, radii, out):
    """Set `out` (N,) to whether each sphere touches one of the frusta (F, 5, 4)."""
    for g in range(len(means)):
        out[g] = _touches(planes, means[g, 0], means[g, 1], means[g, 2], radii[g]) > 0


@kernel(error_model="numpy")
def active_words(ids, owners, active, owing):
    """Add terms `ids` (A,) to the packed set `active` (X,), and the Gaussians that own them to `owing` (W,)."""
    one = np.uint64(1)
    for k in range(len(ids)):
        t = ids[k]
        active[t >> 6] |= one << np.uint64(t & 63)
        g = owners[t]
        owing[g >> 6] |= one << np.uint64(g & 63)
