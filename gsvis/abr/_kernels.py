"""Kernels of planning: sets of 64 Gaussians that travel together, ranked by what they give, and the next that fit.

Sets are packed words (see `gsvis.visibility._kernels_store`). A unit is a word with a mask: members of one weight class
and one pair of levels. A bucket is a gain rounded to 32 steps for each halving, 0 the largest.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from gsvis.visibility._kernels_store import _lowest, _ones

_OPTIONS: dict[str, Any] = {"cache": True, "nogil": True}
BUCKETS = 1024
_BASE = 129 * 32 - (BUCKETS - 1)  # a gain of 4, the largest there is: its float32 without the last 18 bits
GEOMETRY, TERMS = 0, 1
INSIDE, OUTSIDE = 0, 1


@njit(inline="always")
def _has(words, i):
    return (words[i >> 6] >> np.uint64(i & 63)) & np.uint64(1) != 0


@njit(inline="always")
def _put(words, i):
    words[i >> 6] |= np.uint64(1) << np.uint64(i & 63)


@njit(**_OPTIONS)
def bucket_of(gain):
    """Bucket of a gain >= 0: weighted solid angle for each byte."""
    place = np.int64(np.float32(gain).view(np.int32) >> 18) - _BASE
    return BUCKETS - 1 - min(max(place, 0), BUCKETS - 1)


@njit(**_OPTIONS)
def word_spheres(means, radii, areas, spheres, spreads):
    """A sphere around the Gaussians of each word, and the mean square of their distance from its middle.

    Args:
        means: (N, 3).
        radii: (N,).
        areas: (N,), by which the middle is weighted.
        spheres: (W, 4) receives middle and radius.
        spreads: (W,) receives the squares.
    """
    n = len(means)
    for w in range(-(-n // 64)):
        low, high = 64 * w, min(64 * w + 64, n)
        x, y, z, total = 0.0, 0.0, 0.0, 0.0
        for g in range(low, high):
            share = min(np.float64(areas[g]), 1e12) + 1e-12
            x, y, z = x + share * means[g, 0], y + share * means[g, 1], z + share * means[g, 2]
            total += share
        x, y, z = x / total, y / total, z / total
        reach, spread = 0.0, 0.0
        for g in range(low, high):
            a, b, c = means[g, 0] - x, means[g, 1] - y, means[g, 2] - z
            square = a * a + b * b + c * c
            share = min(np.float64(areas[g]), 1e12) + 1e-12
            spread += share * square
            reach = max(reach, np.sqrt(square) + radii[g])
        spheres[w, 0], spheres[w, 1], spheres[w, 2] = x, y, z
        spheres[w, 3] = min(reach * 1.000001 + 1e-30, 1e30)
        spreads[w] = min(spread / total, 1e30)


@njit(**_OPTIONS)
def cell_units(members, ring, scene, class_weights, found, filled):
    """Split the members of a cell into units, and append them.

    Args:
        members: (words, classes), classes of the members in rising order.
        ring: number of the ring they are in.
        scene: (strengths (N, 2), first, last).
        class_weights: (K,).
        found: (words, masks, strengths (U, 2), labels (U, 3)) receive the units, labels: ring, first, last.
        filled: how many there are before.

    Returns:
        How many there are after.
    """
    words, classes = members
    strengths, first, last = scene
    out_words, out_masks, out_strengths, out_labels = found
    one = np.uint64(1)
    masks = np.zeros(256, np.uint64)
    rank = 0
    for w in range(len(words)):
        rest = words[w]
        if not rest:
            continue
        low_class, high_class = 255, 0
        g0 = 64 * w
        lead = np.int64(_lowest(rest))
        levels, mixed = first[g0 + lead] * 16 + last[g0 + lead], False
        while rest:
            low = np.int64(_lowest(rest))
            kind = np.int64(classes[rank])
            rank += 1
            masks[kind] |= one << np.uint64(low)
            low_class, high_class = min(low_class, kind), max(high_class, kind)
            mixed |= first[g0 + low] * 16 + last[g0 + low] != levels
            rest &= rest - one
        for kind in range(low_class, high_class + 1):
            whole = masks[kind]
            masks[kind] = 0
            while whole:
                lead = np.int64(_lowest(whole))
                enters, ends = first[g0 + lead], last[g0 + lead]
                mask, area, pixel, count = np.uint64(0), 0.0, 0.0, 0
                rest = whole
                while rest:
                    low = np.int64(_lowest(rest))
                    rest &= rest - one
                    if not mixed or (first[g0 + low] == enters and last[g0 + low] == ends):
                        mask |= one << np.uint64(low)
                        area += strengths[g0 + low, 0]
                        pixel += strengths[g0 + low, 1]
                        count += 1
                whole &= ~mask
                out_words[filled], out_masks[filled] = w, mask
                out_strengths[filled, 0] = class_weights[kind] * area / count
                out_strengths[filled, 1] = class_weights[kind] * pixel / count
                out_labels[filled, 0], out_labels[filled, 1], out_labels[filled, 2] = ring, enters, ends
                filled += 1
    return filled


@njit(**_OPTIONS)
def add_words(words, seen, fresh):
    """Add to `fresh` what `words` have and `seen` has not."""
    for w in range(len(words)):
        fresh[w] |= words[w] & ~seen[w]


@njit(**_OPTIONS)
def ring_units(fresh, ring, every, found, filled):
    """Append what of the units of all Gaussians (`every`) is in a ring; other arguments as those of `cell_units`."""
    words, masks, strengths, labels = every
    out_words, out_masks, out_strengths, out_labels = found
    for u in range(len(words)):
        mask = masks[u] & fresh[words[u]]
        if mask:
            out_words[filled], out_masks[filled] = words[u], mask
            out_strengths[filled, 0], out_strengths[filled, 1] = strengths[u, 0], strengths[u, 1]
            out_labels[filled, 0], out_labels[filled, 1], out_labels[filled, 2] = ring, labels[u, 1], labels[u, 2]
            filled += 1
    return filled


@njit(**_OPTIONS)
def level_bytes(units, word_bytes, sums):
    """Add to sums (L + 1,), as differences from level to level, the bytes of the units of ring 0."""
    words, masks, _, labels = units
    for u in range(len(words)):
        if labels[u, 0] == 0:
            size = np.float64(_ones(masks[u])) * word_bytes[words[u]]
            sums[labels[u, 1]] += size
            sums[labels[u, 2] + 1] -= size


@njit(inline="always")
def _touches(planes, x, y, z, radius):
    """2 where a sphere is inside one of the frusta, 1 where it touches one, else 0."""
    best = 0
    for f in range(planes.shape[0]):
        whole, part = True, True
        for k in range(planes.shape[1]):
            far = planes[f, k, 0] * x + planes[f, k, 1] * y + planes[f, k, 2] * z + planes[f, k, 3]
            if far + radius < 0.0:
                part = False
                break
            whole &= far >= radius
        if part:
            best = max(best, 2 if whole else 1)
    return best


@njit(**_OPTIONS)
def in_view(planes, means, radii, out):
    """Which spheres (N,) touch one of the frusta (F, 5, 4)."""
    for g in range(len(means)):
        out[g] = _touches(planes, means[g, 0], means[g, 1], means[g, 2], radii[g]) > 0


@njit(inline="always")
def _count_left(active, held, start, stop):
    """Bits in [start, stop) that are in `active` and not in `held`."""
    if start >= stop:
        return 0
    total = 0
    ones = ~np.uint64(0)
    first, final = start >> 6, (stop - 1) >> 6
    for w in range(first, final + 1):
        word = active[w] & ~held[w]
        if w == first:
            word &= ones << np.uint64(start & 63)
        if w == final:
            word &= ones >> np.uint64(63 - ((stop - 1) & 63))
        total += np.int64(_ones(word))
    return total


@njit(**_OPTIONS)
def rank(units, active, held, scene, view, offsets, limits, work):
    """The units that are left, by key: what their class, level and kind add, and the bucket of their gain.

    Args:
        units: (words, masks, strengths, labels).
        active: words of the active terms; empty where there are none.
        held: (Gaussians, terms, gone) as words.
        scene: (spheres, spreads, word_bytes, term_offsets, mean bytes of a term).
        view: (eye (3,) float32, planes (F, 5, 4) float32).
        offsets: (5, L, 2) int64: in view, out of view, rings 1 to 3; level; geometry or terms.
        limits: (lowest last level that is sent, bytes that suffice, least key).
        work: (keys (4 U,) int32, counts (K + 1,) int64 zeros, sizes (K,) float64 zeros, plan (4 U,) int32); an entry of
            the plan is a unit times 4, plus 2 for terms, plus 1 for what is out of view.

    Returns:
        Length of the plan, the largest key in it, and whether it has all that is left.
    """
    words, masks, strengths, labels = units
    gaussians, held_terms, gone = held
    spheres, spreads, word_bytes, term_offsets, term_size = scene
    eye, planes = view
    top, enough, least = limits
    keys, counts, sizes, plan = work
    count = len(term_offsets) - 1
    for u in range(len(words)):
        for k in range(4):
            keys[4 * u + k] = -1
        w = np.int64(words[u])
        alive = masks[u] & ~gone[w]
        if labels[u, 2] < top or not alive:
            continue
        fresh = np.float64(_ones(alive & ~gaussians[w]))
        ring = np.int64(labels[u, 0])
        left = 0
        if ring == 0 and len(active):
            left = _count_left(active, held_terms, term_offsets[64 * w], term_offsets[min(64 * w + 64, count)])
        if fresh == 0.0 and left == 0:
            continue
        x, y, z = spheres[w, 0] - eye[0], spheres[w, 1] - eye[1], spheres[w, 2] - eye[2]
        square = x * x + y * y + z * z + spreads[w] + np.float32(1e-12)
        bucket = bucket_of(strengths[u, 0] / square + strengths[u, 1])
        level = labels[u, 1]
        place = 0
        if ring == 0:
            place = _touches(planes, spheres[w, 0], spheres[w, 1], spheres[w, 2], spheres[w, 3])
        for part in range(2):
            if ring == 0 and place == (0 if part == INSIDE else 2):
                continue
            if ring > 0 and part == INSIDE:
                continue
            group = part if ring == 0 else 1 + ring
            if fresh > 0.0:
                key = offsets[group, level, GEOMETRY] + bucket
                if key >= least:
                    keys[4 * u + part] = key
                    counts[key + 1] += 1
                    sizes[key] += fresh * word_bytes[w]
            if left > 0:
                key = offsets[group, level, TERMS] + bucket
                if key >= least:
                    keys[4 * u + 2 + part] = key
                    counts[key + 1] += 1
                    sizes[key] += left * term_size
    total, last = 0.0, len(sizes) - 1
    for key in range(len(sizes)):
        total += sizes[key]
        if total >= enough:
            last = key
            break
    for key in range(len(sizes)):
        counts[key + 1] += counts[key]
    length, whole = counts[last + 1], counts[len(sizes)]
    for entry in range(4 * len(words)):
        key = keys[entry]
        if 0 <= key <= last:
            plan[counts[key]] = entry
            counts[key] += 1
    return length, last, length == whole


@njit(**_OPTIONS)
def take(plan, place, units, active, held, scene, links, view, budget, out):
    """The next records of a plan, as long as they fit; they count as held from then on.

    Args:
        plan: (P,) entries.
        place: where to go on in it.
        units: (words, masks, strengths, labels).
        active: words of the active terms.
        held: (Gaussians, terms, gone) as words; changed.
        scene: (means, radii, gaussian_bytes, term_offsets, term_bytes).
        links: (words of all candidates, offsets and ids of replacements, offsets and ids of replaced).
        view: (eye, planes).
        budget: bytes.
        out: (Gaussians, terms, dropped) receive ids; and room for as many as can be dropped.

    Returns:
        Where to go on, numbers of Gaussians, terms, and dropped Gaussians, and bytes.
    """
    words, masks, _, labels = units
    gaussians, held_terms, gone = held
    means, radii, sizes, term_offsets, term_sizes = scene
    planes = view[1]
    out_gaussians, out_terms, out_dropped, queue = out
    found, found_terms, dropped, total = 0, 0, 0, 0.0
    one = np.uint64(1)
    while place < len(plan):
        u, terms, part = plan[place] >> 2, plan[place] & 2 != 0, plan[place] & 1
        w = np.int64(words[u])
        rest = masks[u] & ~gone[w] & (gaussians[w] if terms else ~gaussians[w])
        sided = labels[u, 0] == 0
        while rest:
            g = 64 * w + np.int64(_lowest(rest))
            rest &= rest - one
            if sided and (_touches(planes, means[g, 0], means[g, 1], means[g, 2], radii[g]) > 0) != (part == INSIDE):
                continue
            if not terms:
                if gone[w] >> np.uint64(g & 63) & one:
                    continue  # replaced by one before it in this word
                if total + sizes[g] > budget:
                    return place, found, found_terms, dropped, total
                total += sizes[g]
                out_gaussians[found] = g
                found += 1
                _put(gaussians, g)
                dropped = _let_go(g, held, links, queue, out_dropped, dropped)
            else:
                for t in range(term_offsets[g], term_offsets[g + 1]):
                    if _has(active, t) and not _has(held_terms, t):
                        if total + term_sizes[t] > budget:
                            return place, found, found_terms, dropped, total
                        total += term_sizes[t]
                        out_terms[found_terms] = t
                        found_terms += 1
                        _put(held_terms, t)
        place += 1
    return place, found, found_terms, dropped, total


@njit(inline="always")
def _let_go(g, held, links, queue, out, dropped):
    """Mark as gone those whose place g takes and whose other replacements are there, or not to be seen here.

    What is gone has been replaced itself: it counts as there, and those whose place it was to take are looked at, too.
    """
    gaussians, _, gone = held
    candidates, offsets, ids, replaced_offsets, replaced = links
    waiting, done, y = 0, 0, g
    while True:
        for k in range(replaced_offsets[y], replaced_offsets[y + 1]):
            x = np.int64(replaced[k])
            if _has(gone, x):
                continue
            complete = True
            for m in range(offsets[x], offsets[x + 1]):
                h = np.int64(ids[m])
                if _has(candidates, h) and not _has(gaussians, h) and not _has(gone, h):
                    complete = False
                    break
            if complete:
                _put(gone, x)
                queue[waiting] = x
                waiting += 1
                if _has(gaussians, x):
                    out[dropped] = x
                    dropped += 1
        if done == waiting:
            return dropped
        y = np.int64(queue[done])
        done += 1
