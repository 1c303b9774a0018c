"""Kernels that plan for one client: rank units by gain, and take the next records that fit.

Loops over all words and units of a cell have no branches, so that they run in SIMD lanes. Whether single Gaussians are
in view is tested only for the words that a plan can reach. Inner loops take arrays one by one, because numba counts
references when it takes arrays out of tuples. Sets, units and buckets are those of `units`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from gsvis._kernels.bits import lowest, ones
from gsvis.abr._kernels.units import BUCKETS, GEOMETRY, INSIDE, LEAST, TERMS

_OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy"}
_SAMPLE, _SPARE = 16, 1.5
NEVER = 1 << 30  # the key of what is never sent
UNKNOWN, DONE = -1, -2  # in `Cell.waits`: not checked in this cell yet; replaced
SEVERAL = -2  # in `Links.only`


class Cell(NamedTuple):
    """A cell as one client sees it; S words have candidates, E Gaussians are replaced by others."""

    words: Any  # (S,) int32 rising, number of each word
    places: Any  # (6, S) float32, see `Candidates.places`
    term_bytes: Any  # mean bytes of the active terms of a Gaussian that has some
    owed: Any  # (S,) uint64, Gaussians that may have active terms that are not held
    active: Any  # active terms as a packed set
    candidates: Any  # (W,) uint64, all candidates
    waits: Any  # (E, 2) int32, id and place of the replacement that each waits for


class Held(NamedTuple):
    """What a client holds, as packed sets."""

    gaussians: Any
    terms: Any
    gone: Any  # Gaussians that have been replaced


class View(NamedTuple):
    """What a client looks at."""

    eye: Any  # (3,) float32
    planes: Any  # (F, 5, 4) float32 frusta
    bodies: Any  # (4, 64 W) float32, see `CandidateIndex.bodies`


class Limits(NamedTuple):
    """How far to rank."""

    enough: Any  # bytes that suffice
    least: Any  # lowest key


class Plan(NamedTuple):
    """P entries in the order in which they are sent."""

    entries: Any  # (P,) int32, number of a word times 2, plus 1 for terms
    sets: Any  # (P,) uint64, which of its Gaussians


class Records(NamedTuple):
    """Bytes of the records."""

    sizes: Any  # (N,) of Gaussians, (1,) where all are equal
    term_offsets: Any  # (N + 1,)
    term_sizes: Any  # (T,)


class Links(NamedTuple):
    """Which Gaussians replace which; E are replaced."""

    only: Any  # (N,) number, in [0, E), of the one that each replaces; -1 for none, `SEVERAL` for more
    offsets: Any  # (N + 1,) into `ranks`
    ranks: Any  # numbers of all that each replaces
    ending: Any  # (E,) ids of the replaced
    starts: Any  # (E + 1,) into `ids`
    ids: Any  # replacements of each


class Taken(NamedTuple):
    """Room for the ids of a batch."""

    gaussians: Any
    terms: Any
    dropped: Any
    queue: Any  # scratch


class Work(NamedTuple):
    """Scratch of `rank` for S words, U units and K keys."""

    inside: Any  # (S,) uint64
    free: Any  # (S,) uint64
    due: Any  # (S,) uint64
    sides: Any  # (S,) uint8
    squares: Any  # (S,) float32
    gains: Any  # (U,) float32
    buckets: Any  # (U,) int32
    chosen: Any  # (U,) int32
    keys: Any  # (4 U,) int32
    entries: Any  # (4 U,) int32
    sets: Any  # (4 U,) uint64
    counts: Any  # (K,) int64
    sizes: Any  # (K,) float64


@njit(inline="always")
def _has(words, i):
    return (words[i >> 6] >> np.uint64(i & 63)) & np.uint64(1) != 0


@njit(inline="always")
def _put(words, i):
    words[i >> 6] |= np.uint64(1) << np.uint64(i & 63)


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
    """Return whether a bit in [start, stop) is in `active` and not in `held`."""
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


@njit(**_OPTIONS)
def _test_words(x, y, z, radii, p, sides):
    """Raise `sides` (S,) to 1 where a sphere touches a frustum (5, 4), to 2 where it is inside."""
    a0, b0, c0, d0 = p[0, 0], p[0, 1], p[0, 2], p[0, 3]
    a1, b1, c1, d1 = p[1, 0], p[1, 1], p[1, 2], p[1, 3]
    a2, b2, c2, d2 = p[2, 0], p[2, 1], p[2, 2], p[2, 3]
    a3, b3, c3, d3 = p[3, 0], p[3, 1], p[3, 2], p[3, 3]
    a4, b4, c4, d4 = p[4, 0], p[4, 1], p[4, 2], p[4, 3]
    for s in range(len(x)):
        u, v, w, r = x[s], y[s], z[s], radii[s]
        far = a0 * u + b0 * v + c0 * w + d0
        other = a1 * u + b1 * v + c1 * w + d1
        far = other if other < far else far
        other = a2 * u + b2 * v + c2 * w + d2
        far = other if other < far else far
        other = a3 * u + b3 * v + c3 * w + d3
        far = other if other < far else far
        other = a4 * u + b4 * v + c4 * w + d4
        far = other if other < far else far
        side = np.uint8(far + r >= np.float32(0.0)) + np.uint8(far >= r)
        sides[s] = side if side > sides[s] else sides[s]


@njit(**_OPTIONS)
def _test_gaussians(words, places, bodies, planes, sides, inside):
    """Set which Gaussians of words (S,) are in a frustum (F, 5, 4); test them one by one where the side is 3."""
    xs, ys, zs, sizes = bodies[0], bodies[1], bodies[2], bodies[3]
    near, depth = np.empty(64, np.float32), np.empty(64, np.float32)
    for s in range(len(words)):
        inside[s] = ~np.uint64(0) if sides[s] == 2 else np.uint64(0)
        if sides[s] != 3:
            continue
        low = 64 * np.int64(words[s])
        x, y, z, radii = xs[low : low + 64], ys[low : low + 64], zs[low : low + 64], sizes[low : low + 64]
        near[:] = -1.0
        for f in range(len(planes)):
            depth[:] = 0.0
            for k in range(5):
                a, b, c, d = planes[f, k, 0], planes[f, k, 1], planes[f, k, 2], planes[f, k, 3]
                far = a * places[0, s] + b * places[1, s] + c * places[2, s] + d
                if far >= places[3, s]:
                    continue  # the whole word is inside this plane
                if far + places[3, s] < np.float32(0.0):
                    depth[:] = -1.0
                    break
                for i in range(64):
                    there = a * x[i] + b * y[i] + c * z[i] + d + radii[i]
                    depth[i] = there if there < depth[i] else depth[i]
            for i in range(64):
                near[i] = depth[i] if depth[i] > near[i] else near[i]
        bits = np.uint64(0)
        for i in range(64):
            bits |= np.uint64(near[i] >= np.float32(0.0)) << np.uint64(i)
        inside[s] = bits


@njit(**_OPTIONS)
def _gather(words, owed, gaussians, gone, free, due):
    """Set what is neither held nor gone (`free`), and what is owed and not gone (`due`), for words (S,)."""
    for s in range(len(words)):
        w = words[s]
        free[s], due[s] = ~(gaussians[w] | gone[w]), owed[s] & ~gone[w]


@njit(**_OPTIONS)
def _squares(x, y, z, spreads, eye, out):
    """Set the mean square of the distances between the Gaussians of each word and the eye."""
    a, b, c = eye[0], eye[1], eye[2]
    for s in range(len(x)):
        u, v, w = x[s] - a, y[s] - b, z[s] - c
        out[s] = u * u + v * v + w * w + spreads[s] + np.float32(1e-12)


@njit(**_OPTIONS)
def _gains(slots, areas, pixels, squares, out):
    """Set the gain of each unit."""
    for u in range(len(slots)):
        out[u] = areas[u] / squares[slots[u]] + pixels[u]


@njit(**_OPTIONS)
def _buckets(bits, out):
    """Set the bucket of each gain, given by its bits; see `bucket_of`."""
    for u in range(len(bits)):
        place = (bits[u] >> 18) - LEAST
        place = 0 if place < 0 else place
        out[u] = BUCKETS - 1 - (place if place < BUCKETS - 1 else BUCKETS - 1)


@njit(**_OPTIONS)
def _estimate_limit(units, runs, cell, table, limits, work):
    """Return a key below which about enough bytes lie, estimated from a sample of the words; at most all keys."""
    masks, codes, buckets = units.masks, units.codes, work.buckets
    starts, run_slots = runs
    free, due, sides, sizes = work.free, work.due, work.sides, work.sizes
    word_bytes, term_bytes = cell.places[5], cell.term_bytes
    enough, least = limits
    sizes[:] = 0.0
    for r in range(0, len(run_slots), _SAMPLE):
        s = run_slots[r]
        side = 0 if sides[s] else 1
        for u in range(starts[r], starts[r + 1]):
            for kind in range(2):
                key = table[codes[u], kind, side] + buckets[u]
                if key < NEVER:
                    left = masks[u] & (free[s] if kind == GEOMETRY else due[s])
                    sizes[key] += np.float64(ones(left)) * (word_bytes[s] if kind == GEOMETRY else term_bytes)
    total = 0.0
    for key in range(least, len(sizes)):
        total += _SAMPLE * sizes[key]
        if total > _SPARE * enough:
            return key + 1
    return len(sizes)


@njit(**_OPTIONS)
def _choose(units, runs, table, limit, work):
    """Choose the units that may have a key below a limit; mark their words on a border with 3, for a closer test.

    Returns:
        Number of chosen units, and whether no other unit is left to send.
    """
    masks, codes, buckets, chosen = units.masks, units.codes, work.buckets, work.chosen
    starts, run_slots = runs
    free, due, sides = work.free, work.due, work.sides
    filled, every = 0, True
    for r in range(len(run_slots)):
        s = run_slots[r]
        rest, fresh = free[s] | due[s], free[s]
        if not rest:
            continue
        side, before = 0 if sides[s] else 1, filled
        for u in range(starts[r], starts[r + 1]):
            kind = GEOMETRY if masks[u] & fresh else TERMS
            key = table[codes[u], kind, side] + buckets[u]
            if key < limit:
                chosen[filled] = u
                filled += 1 if masks[u] & rest else 0
            elif every and key < NEVER and masks[u] & rest:
                every = False
        if sides[s] == 1 and filled > before:
            sides[s] = 3
    return filled, every


@njit(**_OPTIONS)
def rank(units, runs, cell, held, view, table, limits, work):
    """Rank the units that are left by key: the offset of their class, level and kind, plus the bucket of their gain.

    Args:
        units: `Units` of the cell.
        runs: `Runs` of them.
        cell: `Cell`.
        held: `Held`.
        view: `View`.
        table: (4 L L, 2, 2) int32, the offset of a bucket: by code, geometry or terms, in view or out of view.
        limits: `Limits`.
        work: `Work` with S words, U units and K keys; see `CandidateIndex.work`.

    Returns:
        `Plan`, the key at which it ends, and whether it holds all that is left.
    """
    slots, masks, areas, pixels, codes = units
    words, places, term_bytes = cell.words, cell.places, cell.term_bytes
    inside, free, due, sides, squares, gains, buckets, chosen, keys, entries, sets, counts, sizes = work
    least = limits.least
    x, y, z, word_bytes = places[0], places[1], places[2], places[5]
    _gather(words, cell.owed, held.gaussians, held.gone, free, due)
    sides[:] = 0
    for f in range(len(view.planes)):
        _test_words(x, y, z, places[3], view.planes[f], sides)
    _squares(x, y, z, places[4], view.eye, squares)
    _gains(slots, areas, pixels, squares, gains)
    _buckets(gains.view(np.int32), buckets)
    limit = _estimate_limit(units, runs, cell, table, limits, work)
    count, whole = _choose(units, runs, table, limit, work)
    _test_gaussians(words, places, view.bodies, view.planes, sides, inside)
    own = len(table) // 4  # codes of ring 0
    counts[:limit], sizes[:limit] = 0, 0.0
    filled = 0
    for j in range(count):
        u = chosen[j]
        s, code = slots[u], codes[u]
        seen = inside[s] if code < own else np.uint64(0)
        for kind in range(2):
            left = masks[u] & (free[s] if kind == GEOMETRY else due[s])
            share = np.float64(word_bytes[s]) if kind == GEOMETRY else term_bytes
            for part in range(2):
                bits, key = left & (seen if part == INSIDE else ~seen), table[code, kind, part] + buckets[u]
                if not bits or key < least or key >= NEVER:
                    continue
                if key >= limit:
                    whole = False
                    continue
                keys[filled], entries[filled], sets[filled] = key, 2 * s + kind, bits
                filled += 1
                counts[key] += 1
                sizes[key] += np.float64(ones(bits)) * share
    total, stop, length = 0.0, least, 0
    while stop < limit and total < limits.enough:
        total += sizes[stop]
        counts[stop], length = length, length + counts[stop]
        stop += 1
    plan = Plan(np.empty(length, np.int32), np.empty(length, np.uint64))
    for k in range(filled):
        key = keys[k]
        if key < stop:
            plan.entries[counts[key]], plan.sets[counts[key]] = entries[k], sets[k]
            counts[key] += 1
    return plan, stop, whole and length == filled


@njit(**_OPTIONS)
def take(plan, place, cell, held, records, links, budget, out):
    """Take the next records of a plan that fit into a budget, and mark them as held.

    Args:
        plan: `Plan`.
        place: Entry to continue at.
        cell: `Cell`; clears what is paid in `owed`, and changes `waits`.
        held: `Held`; changed.
        records: `Records`.
        links: `Links`.
        budget: Bytes.
        out: `Taken`, receives ids; `dropped` and `queue` have room for all that can be dropped.

    Returns:
        Entry to continue at, numbers of Gaussians, terms and dropped Gaussians, and bytes.
    """
    entries, sets = plan
    words, owed, active = cell.words, cell.owed, cell.active
    gaussians, held_terms, gone = held
    sizes, term_offsets, term_sizes = records
    only, waits = links.only, cell.waits
    out_gaussians, out_terms = out.gaussians, out.terms
    size, varied = np.float64(sizes[0]) if len(sizes) else 0.0, len(sizes) > 1
    found, found_terms, dropped, total = 0, 0, np.int64(0), 0.0  # a literal would compile `_drop_replaced` twice
    one, ones = np.uint64(1), ~np.uint64(0)
    while place < len(entries):
        s, terms = np.int64(entries[place] >> 1), entries[place] & 1 != 0
        w = np.int64(words[s])
        rest = sets[place] & ~gone[w] & (gaussians[w] & owed[s] if terms else ~gaussians[w])
        while rest:
            low = lowest(rest)
            rest &= rest - one
            g = 64 * w + np.int64(low)
            if not terms:
                size = np.float64(sizes[g]) if varied else size
                if total + size > budget:
                    return place, found, found_terms, dropped, total
                total += size
                out_gaussians[found] = g
                found += 1
                gaussians[w] |= one << low
                e = np.int64(only[g])
                if e == SEVERAL or (e >= 0 and (waits[e, 0] == UNKNOWN or waits[e, 0] == g)):
                    dropped = _drop_replaced(g, held, cell, links, out, dropped)
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
                    t = 64 * k + np.int64(lowest(left))
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


@njit(**_OPTIONS)
def _drop_replaced(g, held, cell, links, out, dropped):
    """Mark as gone what g replaces, where all other replacements are held or cannot be seen from the cell.

    A Gaussian that is gone counts as held, so what it was to replace is checked too. What still waits remembers one
    missing replacement in `waits`, and is not checked again before that arrives.
    """
    gaussians, gone, candidates, waits = held.gaussians, held.gone, cell.candidates, cell.waits
    offsets, ranks, ending, starts, ids = links.offsets, links.ranks, links.ending, links.starts, links.ids
    queue, out_dropped = out.queue, out.dropped
    waiting, done, y = 0, 0, g
    while True:
        for k in range(offsets[y], offsets[y + 1]):
            e = ranks[k]
            if waits[e, 0] != UNKNOWN and waits[e, 0] != y:
                continue
            x = np.int64(ending[e])
            if _has(gone, x):
                waits[e, 0] = DONE
                continue
            m = starts[e] if waits[e, 0] == UNKNOWN else np.int64(waits[e, 1])
            while m < starts[e + 1]:
                h = np.int64(ids[m])
                if _has(candidates, h) and not _has(gaussians, h) and not _has(gone, h):
                    break
                m += 1
            if m < starts[e + 1]:
                waits[e, 0], waits[e, 1] = ids[m], m
                continue
            waits[e, 0] = DONE
            _put(gone, x)
            queue[waiting] = x
            waiting += 1
            if _has(gaussians, x):
                out_dropped[dropped] = x
                dropped += 1
        if done == waiting:
            return dropped
        y = np.int64(queue[done])
        done += 1
