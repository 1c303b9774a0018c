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
        slack = 1e-6 * (reach + abs(x) + abs(y) + abs(z)) + 1e-30  # for what is rounded when depths are computed
        spheres[w, 3] = min(reach + slack, 1e30)
        spreads[w] = min(spread / total, 1e30)


@njit(**_OPTIONS)
def cell_units(members, scene, class_weights, found):
    """Split the members of a cell into units of ring 0.

    Args:
        members: (words, classes), classes of the members in rising order.
        scene: (strengths (N, 2), first, last, mixed (W,): whether a word has more than one pair of levels).
        class_weights: (K,).
        found: (words, masks, strengths (U, 2), labels (U, 3)) receive the units, labels: ring, first, last.

    Returns:
        How many there are.
    """
    words, classes = members
    strengths, first, last, mixed = scene
    out_words, out_masks, out_strengths, out_labels = found
    one = np.uint64(1)
    masks, sums = np.zeros(256, np.uint64), np.zeros((256, 2))
    rank, filled = 0, 0
    for w in range(len(words)):
        rest = words[w]
        if not rest:
            continue
        low_class, high_class = 255, 0
        while rest:
            low = _lowest(rest)
            rest &= rest - one
            kind, g = np.int64(classes[rank]), 64 * w + np.int64(low)
            rank += 1
            masks[kind] |= one << low
            sums[kind, 0] += strengths[g, 0]
            sums[kind, 1] += strengths[g, 1]
            low_class, high_class = min(low_class, kind), max(high_class, kind)
        for kind in range(low_class, high_class + 1):
            whole, area, pixel = masks[kind], sums[kind, 0], sums[kind, 1]
            masks[kind], sums[kind, 0], sums[kind, 1] = 0, 0.0, 0.0
            while whole:
                lead, mask = 64 * w + np.int64(_lowest(whole)), whole
                if mixed[w]:
                    rest, mask, area, pixel = whole, np.uint64(0), 0.0, 0.0
                    while rest:
                        low = _lowest(rest)
                        rest &= rest - one
                        g = 64 * w + np.int64(low)
                        if first[g] == first[lead] and last[g] == last[lead]:
                            mask |= one << low
                            area += strengths[g, 0]
                            pixel += strengths[g, 1]
                whole &= ~mask
                count = np.float64(_ones(mask))
                out_words[filled], out_masks[filled] = w, mask
                out_strengths[filled, 0] = class_weights[kind] * area / count
                out_strengths[filled, 1] = class_weights[kind] * pixel / count
                out_labels[filled, 0], out_labels[filled, 1], out_labels[filled, 2] = 0, first[lead], last[lead]
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


@njit(**_OPTIONS)
def active_words(ids, owners, active, owing):
    """Mark active terms (ids), and the Gaussians that have them (owners: (T,))."""
    one = np.uint64(1)
    for k in range(len(ids)):
        t = ids[k]
        active[t >> 6] |= one << np.uint64(t & 63)
        g = owners[t]
        owing[g >> 6] |= one << np.uint64(g & 63)


@njit(**_OPTIONS)
def forget_paid(words, active, held, term_offsets, owed):
    """Clear in `owed` (S,) the words of Gaussians whose active terms are all held."""
    count = len(term_offsets) - 1
    for s in range(len(words)):
        if owed[s]:
            w = np.int64(words[s])
            if not _left(active, held, term_offsets[64 * w], term_offsets[min(64 * w + 64, count)]):
                owed[s] = 0


@njit(inline="always")
def _left(active, held, start, stop):
    """Whether a bit in [start, stop) is in `active` and not in `held`."""
    if start >= stop:
        return False
    ones = ~np.uint64(0)
    low, high = start >> 6, (stop - 1) >> 6
    for k in range(low, high + 1):
        word = active[k] & ~held[k]
        if k == low:
            word &= ones << np.uint64(start & 63)
        if k == high:
            word &= ones >> np.uint64(63 - ((stop - 1) & 63))
        if word:
            return True
    return False


@njit(inline="always")
def _touching(view, bodies, g0, bits):
    """Which of the 64 Gaussians from g0 on touch a frustum (5, 4) that their sphere straddles; `bits` is room for 64."""
    x, y, z, radii = bodies
    for i in range(64):
        bits[i] = 0.0
    for k in range(5):
        a, b, c, d = view[k, 0], view[k, 1], view[k, 2], view[k, 3]
        for i in range(64):
            far = a * x[g0 + i] + b * y[g0 + i] + c * z[g0 + i] + d + radii[g0 + i]
            bits[i] = far if far < bits[i] else bits[i]
    out = np.uint64(0)
    for i in range(64):
        out |= np.uint64(bits[i] >= 0.0) << np.uint64(i)
    return out


@njit(**_OPTIONS)
def look(spheres, words, wanted, bodies, planes, inside, room):
    """Which Gaussians of some words are in view.

    Args:
        spheres: (x, y, z, radius), each (S,), around the Gaussians of each word.
        words: (S,) numbers of the words.
        wanted: (S,) of which Gaussians this is asked.
        bodies: (x, y, z, radius), each (64 W,), of the Gaussians.
        planes: (F, 5, 4) frusta.
        inside: (S,) receives the Gaussians that touch one of them.
        room: (S,) float32.
    """
    x, y, z, radii = spheres
    bits = np.empty(64, np.float32)
    inside[:] = 0
    for f in range(len(planes)):
        p = planes[f]
        _depths(x, y, z, p, room)
        for s in range(len(words)):
            if room[s] >= radii[s]:
                inside[s] = ~np.uint64(0)
            elif room[s] + radii[s] >= 0.0 and wanted[s] & ~inside[s]:
                inside[s] |= _touching(p, bodies, 64 * np.int64(words[s]), bits)


@njit(**_OPTIONS)
def _depths(x, y, z, p, out):
    """Least distance of points (S,) from the planes of a frustum (5, 4), inwards."""
    a0, b0, c0, d0 = p[0, 0], p[0, 1], p[0, 2], p[0, 3]
    a1, b1, c1, d1 = p[1, 0], p[1, 1], p[1, 2], p[1, 3]
    a2, b2, c2, d2 = p[2, 0], p[2, 1], p[2, 2], p[2, 3]
    a3, b3, c3, d3 = p[3, 0], p[3, 1], p[3, 2], p[3, 3]
    a4, b4, c4, d4 = p[4, 0], p[4, 1], p[4, 2], p[4, 3]
    for s in range(len(out)):
        u, v, w = x[s], y[s], z[s]
        far = a0 * u + b0 * v + c0 * w + d0
        other = a1 * u + b1 * v + c1 * w + d1
        far = other if other < far else far
        other = a2 * u + b2 * v + c2 * w + d2
        far = other if other < far else far
        other = a3 * u + b3 * v + c3 * w + d3
        far = other if other < far else far
        other = a4 * u + b4 * v + c4 * w + d4
        out[s] = other if other < far else far


@njit(**_OPTIONS)
def gather(words, owed, held, free, due):
    """What is neither held nor gone (`free`), and owed and not gone (`due`), for the words (S,) of a cell."""
    gaussians, _, gone = held
    for s in range(len(words)):
        w = words[s]
        free[s] = ~(gaussians[w] | gone[w])
        due[s] = owed[s] & ~gone[w]


@njit(inline="always")
def _enter(entry, key, size, filled, least, work):
    """One more entry for the plan, unless its key is too small."""
    keys, entries, counts, sizes = work
    if key >= least:
        keys[filled], entries[filled] = key, entry
        counts[key] += 1
        sizes[key] += size
        filled += 1
    return filled


@njit(**_OPTIONS)
def rank(units, live, state, scene, eye, offsets, limits, work):
    """The units that are left, by key: what their class, level and kind add, and the bucket of their gain.

    Args:
        units: (slots, masks, strengths, labels).
        live: (U,) int32 units that may have something left; those that have move to its front.
        state: (free, due, inside), each (S,): see `gather` and `look`.
        scene: (x, y, z, spread, bytes of a Gaussian), each (S,), and bytes of the terms of a Gaussian.
        eye: (3,) float32.
        offsets: (5, L, 2) int64: in view, out of view, rings 1 to 3; level; geometry or terms.
        limits: (lowest last level that is sent, bytes that suffice, least key).
        work: (keys (4 U,) int32, entries (4 U,) int32, counts (K,) int64 zeros, sizes (K,) float64 zeros); an entry is
            a unit times 4, plus 2 for terms, plus 1 for what is out of view.

    Returns:
        How many units are live, the plan (its entries), the largest key in it, and whether it has all that is left.
    """
    slots, masks, strengths, labels = units
    free, due, inside = state
    x, y, z, spreads, word_bytes, term_bytes = scene
    top, enough, least = limits
    kept, filled = 0, 0
    for j in range(len(live)):
        u = np.int64(live[j])
        s = np.int64(slots[u])
        fresh, terms = masks[u] & free[s], masks[u] & due[s]
        ring = np.int64(labels[u, 0])
        if ring > 0:
            terms = np.uint64(0)
        if not fresh | terms:
            continue
        live[kept] = u
        kept += 1
        if labels[u, 2] < top:
            continue
        a, b, c = x[s] - eye[0], y[s] - eye[1], z[s] - eye[2]
        square = a * a + b * b + c * c + spreads[s] + np.float32(1e-12)
        bucket = bucket_of(strengths[u, 0] / square + strengths[u, 1])
        level = np.int64(labels[u, 1])
        if ring > 0:
            size = np.float64(_ones(fresh)) * word_bytes[s]
            filled = _enter(4 * u + 1, offsets[1 + ring, level, GEOMETRY] + bucket, size, filled, least, work)
            continue
        for part in range(2):
            seen = inside[s] if part == INSIDE else ~inside[s]
            if fresh & seen:
                size = np.float64(_ones(fresh & seen)) * word_bytes[s]
                filled = _enter(4 * u + part, offsets[part, level, GEOMETRY] + bucket, size, filled, least, work)
            if terms & seen:
                size = np.float64(_ones(terms & seen)) * term_bytes
                filled = _enter(4 * u + 2 + part, offsets[part, level, TERMS] + bucket, size, filled, least, work)
    keys, entries, counts, sizes = work
    total, last, length = 0.0, -1, 0
    while length < filled and total < enough:
        last += 1
        total += sizes[last]
        counts[last], length = length, length + counts[last]
    plan = np.empty(length, np.int32)
    for k in range(filled):
        key = keys[k]
        if key <= last:
            plan[counts[key]] = entries[k]
            counts[key] += 1
    return kept, plan, last, length == filled


@njit(**_OPTIONS)
def take(plan, place, units, cell, held, scene, links, budget, out):
    """The next records of a plan, as long as they fit; they count as held from then on.

    Args:
        plan: (P,) entries.
        place: where to go on in it.
        units: (slots, masks, strengths, labels).
        cell: (words (S,), inside (S,), owed (S,), active terms as words); of owed, what is paid is cleared.
        held: (Gaussians, terms, gone) as words; changed.
        scene: (gaussian_bytes, term_offsets, term_bytes, words of those that take the place of others).
        links: (words of all candidates, offsets and ids of replacements, offsets and ids of replaced).
        budget: bytes.
        out: (Gaussians, terms, dropped) receive ids; and room for as many as can be dropped.

    Returns:
        Where to go on, numbers of Gaussians, terms, and dropped Gaussians, and bytes.
    """
    slots, masks, _, labels = units
    words, inside, owed, active = cell
    gaussians, held_terms, gone = held
    sizes, term_offsets, term_sizes, replacing = scene
    out_gaussians, out_terms, out_dropped, queue = out
    found, found_terms, dropped, total = 0, 0, 0, 0.0
    one, ones = np.uint64(1), ~np.uint64(0)
    while place < len(plan):
        u, terms, part = plan[place] >> 2, plan[place] & 2 != 0, plan[place] & 1
        s = np.int64(slots[u])
        w = np.int64(words[s])
        rest = masks[u] & ~gone[w] & (gaussians[w] & owed[s] if terms else ~gaussians[w])
        if labels[u, 0] == 0:
            rest &= inside[s] if part == INSIDE else ~inside[s]
        while rest:
            low = _lowest(rest)
            rest &= rest - one
            g = 64 * w + np.int64(low)
            if not terms:
                if total + sizes[g] > budget:
                    return place, found, found_terms, dropped, total
                total += sizes[g]
                out_gaussians[found] = g
                found += 1
                gaussians[w] |= one << low
                if replacing[w] >> low & one:
                    dropped = _let_go(g, held, links, queue, out_dropped, dropped)
                    rest &= ~gone[w]
                continue
            start, stop = term_offsets[g], term_offsets[g + 1]
            for k in range(start >> 6, (stop + 63) >> 6):
                left = active[k] & ~held_terms[k]
                if 64 * k < start:
                    left &= ones << np.uint64(start & 63)
                if 64 * k + 64 > stop:
                    left &= ones >> np.uint64(64 * k + 64 - stop)
                while left:
                    t = 64 * k + np.int64(_lowest(left))
                    if total + term_sizes[t] > budget:
                        return place, found, found_terms, dropped, total
                    total += term_sizes[t]
                    out_terms[found_terms] = t
                    found_terms += 1
                    held_terms[k] |= left & (~left + one)
                    left &= left - one
            owed[s] &= ~(one << low)
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
