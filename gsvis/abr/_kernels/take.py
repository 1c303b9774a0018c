"""Kernels that take the next records of a plan, and keep what a client holds and still owes."""

from __future__ import annotations

import numpy as np

from gsvis._kernels.bits import has, lowest
from gsvis._kernels.compiled import kernel, njit
from gsvis._kernels.prefetch import prefetch
from gsvis.abr._kernels.plan import ANY, DONE, KIND_BITS, NONE, SEVERAL, UNITS, only_of

_AHEAD = 8  # entries of a plan ahead for which packed sets are prefetched
_NEXT = 3  # entries ahead for which areas are prefetched
_LINE = 16  # Gaussians in a cache line


@njit(inline="always")
def _put(words, i):
    """Add an id to a packed set."""
    words[i >> 6] |= np.uint64(1) << np.uint64(i & 63)


@kernel(error_model="numpy")
def forget_paid(words, active, held, term_offsets, owed):
    """Set words of `owed` (S,) to 0 if all active terms of their Gaussians are held."""
    count = len(term_offsets) - 1
    for s in range(len(owed)):
        if owed[s]:
            w = np.int64(words[s])
            if not _left(active, held, term_offsets[64 * w], term_offsets[min(64 * w + 64, count)]):
                owed[s] = 0


@kernel(error_model="numpy")
def is_left(seen, wanted, held, owed, allowed):
    """Set `allowed` (S,) to what is seen and wanted; return whether some of it is left to send.

    A Gaussian is left if it is not gone and either not held or owes terms.

    Args:
        seen: `Seen`.
        wanted: (W,) packed set.
        held: `Held`.
        owed: (S,) Gaussians that owe terms; (0,) in a scene without terms.
        allowed: (S,) receives the masks.
    """
    words, masks = seen
    gaussians, _, gone = held
    left = np.uint64(0)
    for s in range(len(words)):
        w = words[s]
        allowed[s] = masks[s] & wanted[w]
        left |= allowed[s] & ~gone[w] & ~gaussians[w]
    for s in range(len(owed)):
        left |= allowed[s] & owed[s] & ~gone[words[s]]
    return left != 0


@njit(inline="always")
def _left(active, held, start, stop):
    """Return whether a bit in [start, stop) is in `active` and not in `held`."""
    if start >= stop:
        return False
    ones = ~np.uint64(0)
    low = start >> 6
    high = (stop - 1) >> 6
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
def _look(bodies, g, area, pixel, eyes, out):
    """Set `out` (P, 4): unit vectors from eyes (P, 3) to a Gaussian, and half the logarithm of its solid angle.

    The direction is (0, 0, 1) for an eye at its center. The solid angle is at most 4 pi.
    """
    for p in range(len(eyes)):
        x = bodies[0, g] - eyes[p, 0]
        y = bodies[1, g] - eyes[p, 1]
        z = bodies[2, g] - eyes[p, 2]
        square = x * x + y * y + z * z
        length = np.sqrt(square)
        if length > 0:
            out[p, 0] = x / length
            out[p, 1] = y / length
            out[p, 2] = z / length
        else:
            out[p, 0] = 0.0
            out[p, 1] = 0.0
            out[p, 2] = 1.0
        out[p, 3] = 0.5 * np.log(min(area / max(square, np.float32(1e-30)) + pixel, 4.0 * np.pi))


@njit(inline="always")
def _change(centers, place, cosine, width, looks):
    """Return the logarithm of the largest change that a term makes for P eyes; `looks` (P, 4) are from `_look`.

    Blending weight and gain are not included.
    """
    x = centers[place, 0]
    y = centers[place, 1]
    z = centers[place, 2]
    most = np.float32(-np.inf)
    for p in range(len(looks)):
        change = x * looks[p, 0] + y * looks[p, 1] + z * looks[p, 2] + looks[p, 3] * width
        most = change if change > most else most
    return (most - cosine) / width


@kernel(error_model="numpy")
def widen(candidates, added, held, links, looks):
    """Add a `Seen` set to the candidates (W,); set `looks` (E,) to 0 for what its arrived Gaussians replace.

    Candidates that have not arrived need no check: they only increase the area that has to arrive.
    """
    gaussians, _, gone = held
    words, masks = added
    only = links.only
    firsts = links.firsts
    offsets = links.offsets
    ranks = links.ranks
    one = np.uint64(1)
    for s in range(len(words)):
        w = np.int64(words[s])
        fresh = masks[s] & ~candidates[w]
        candidates[w] |= fresh
        fresh &= gaussians[w] | gone[w]
        while fresh:
            g = 64 * w + np.int64(lowest(fresh))
            fresh &= fresh - one
            e = only_of(only[g], firsts[w])
            if e >= 0:
                looks[e] = 0
            elif e == SEVERAL:
                for k in range(offsets[g], offsets[g + 1]):
                    looks[ranks[k]] = 0


@kernel(error_model="numpy")
def doubt(ids, links, arrived, looks, looks_far):
    """Mark as unknown (`ANY`) how much has arrived for the Gaussians that `ids` (M,) replace: each will be checked."""
    offsets = links.offsets
    ranks = links.ranks
    for i in range(len(ids)):
        g = ids[i]
        for k in range(offsets[g], offsets[g + 1]):
            e = ranks[k]
            arrived[e] = ANY
            looks[e] = 0
            looks_far[e] = 0


@kernel(error_model="numpy")
def bound(candidates, links, last, shares, room, ends, least, sure):
    """Compute bounds on the area of replacements that must arrive, in `UNITS`, for what candidates replace.

    Args:
        candidates: `Seen`.
        links: `Links`.
        last: (N,) level at which each Gaussian ends.
        shares: `Cell.shares`.
        room: (E,) int32 scratch: zeros before and after the call.
        ends: (E,) int32, receives the numbers of B replaced Gaussians.
        least: (E,) int32, receives the least area with which each of them can be dropped.
        sure: (E,) int32, receives the area with which it is dropped, whichever replacements make it up.

    Returns:
        B.
    """
    only = links.only
    firsts = links.firsts
    offsets = links.offsets
    ranks = links.ranks
    units = links.units
    starts = links.starts
    ending = links.ending
    one = np.uint64(1)
    words, masks = candidates
    count = 0
    for s in range(len(words)):
        w = np.int64(words[s])
        rest = masks[s]
        while rest:
            g = 64 * w + np.int64(lowest(rest))
            rest &= rest - one
            e = only_of(only[g], firsts[w])
            if e == NONE:
                continue
            first = np.int64(0)
            end = np.int64(1)
            if e == SEVERAL:
                first = offsets[g]
                end = offsets[g + 1]
            for k in range(first, end):
                x = e if e >= 0 else np.int64(ranks[k])
                if room[x] == 0:
                    ends[count] = x
                    count += 1
                    room[x] = 1
                room[x] += (np.int32(only[g] >> 16) if e >= 0 else units[k]) - 1
    for k in range(count):
        e = np.int64(ends[k])
        share = shares[last[ending[e]]]
        area = room[e] - 1
        room[e] = 0
        sure[k] = UNITS + np.int64(starts[e + 1] - starts[e]) + 1 - np.int64((1.0 - share) * area)
        least[k] = np.int64(share * area) - 1
    return count


@kernel
def adopt(bounds, looks, sure):
    """Write the `Bounds` of a cell to the arrays `looks` and `sure` (E,) of a client."""
    ends, least, enough = bounds
    for k in range(len(ends)):
        e = ends[k]
        looks[e] = max(looks[e], least[k])
        sure[e] = enough[k]


@kernel(error_model="numpy")
def take(plan, place, cell, held, view, records, links, budget, out):
    """Take the next records of a plan that fit into a budget, and mark them as held.

    Args:
        plan: `Plan`.
        place: Entry to continue at.
        cell: `Cell`; its `owed`, `checked`, `arrived` and `looks` are updated.
        held: `Held`; changed.
        view: `View`.
        records: `Records`.
        links: `Links`.
        budget: Bytes.
        out: `Taken`, receives ids; `dropped` and `gone` have E entries.

    Returns:
        Entry to continue at, numbers of Gaussians, terms, dropped and gone Gaussians, and bytes.
    """
    entries, sets, logs = plan
    words = cell.words
    owed = cell.owed
    active = cell.active
    checked = cell.checked
    gaussians, held_terms, gone = held
    sizes, term_offsets, term_sizes, centers, centers_of, cosines, widths, areas = records
    eyes = view.eyes
    bodies = view.bodies
    toward = np.empty((len(view.eyes), 4), np.float32)
    only = links.only
    firsts = links.firsts
    arrived = cell.arrived
    looks = cell.looks
    gains = view.gains
    candidates = cell.candidates
    sure = cell.sure
    last = cell.last
    shares = cell.shares
    offsets = links.offsets
    ranks = links.ranks
    ending = links.ending
    starts = links.starts
    ids = links.ids
    units = links.units
    weights = links.areas
    every = links.every
    out_gaussians = out.gaussians
    out_terms = out.terms
    out_dropped = out.dropped
    queue = out.gone
    size = np.float64(sizes[0]) if len(sizes) else 0.0
    varied = len(sizes) > 1
    found = 0
    found_terms = 0
    dropped = np.int64(0)
    replaced = np.int64(0)
    total = 0.0
    one = np.uint64(1)
    ones = ~np.uint64(0)

    # A nested function: at module level, numba would count references of thirty arrays in each call.
    def drop_replaced(g, dropped, replaced):
        """Mark as gone the Gaussians that g replaces, if enough of their replacements that can be seen are held.

        Enough is a share of their area, `Cell.shares`. A Gaussian that is gone counts as held, so the Gaussians that it
        replaces are checked too. If not enough has arrived, `looks` is set to the area in `UNITS`, rounded down, before
        which no check can succeed. With the area `sure` a Gaussian is dropped without a check.

        Returns:
            The new numbers of dropped and of replaced Gaussians.
        """
        waiting = replaced
        done = replaced
        y = g
        while True:
            is_new = y == g or not has(gaussians, y)
            one_only = only_of(only[y], firsts[y >> 6])
            first = np.int64(0)
            end = np.int64(one_only >= 0)
            if one_only == SEVERAL:
                first = offsets[y]
                end = offsets[y + 1]
            for k in range(first, end):
                e = one_only if one_only >= 0 else np.int64(ranks[k])
                if is_new:
                    arrived[e] += np.int32(only[y] >> 16) if one_only >= 0 else units[k]
                if arrived[e] < looks[e]:
                    continue
                x = np.int64(ending[e])
                if has(gone, x):
                    looks[e] = DONE
                    continue
                if not 0 < sure[e] <= arrived[e] < ANY:
                    total = 0.0
                    missing = 0.0
                    for m in range(starts[e], starts[e + 1]):
                        w = ids[m] >> 6
                        bit = np.uint64(ids[m] & 63)
                        counts = candidates[w]
                        lacks = candidates[w] & ~(gaussians[w] | gone[w])
                        total += np.float64((counts >> bit) & one) * weights[m]
                        missing += np.float64((lacks >> bit) & one) * weights[m]
                    spare = 1.0 - shares[last[x]]
                    if missing > spare * total:
                        looks[e] = arrived[e] + max(np.int64((missing - spare * total) / every[e] * UNITS) - 1, 1)
                        continue
                looks[e] = DONE
                _put(gone, x)
                queue[waiting] = x
                waiting += 1
                if has(gaussians, x):
                    out_dropped[dropped] = x
                    dropped += 1
            if done == waiting:
                return dropped, waiting
            y = np.int64(queue[done])
            done += 1

    while place < len(entries):
        s = np.int64(entries[place] >> KIND_BITS)
        kind = np.int64(entries[place] & ((1 << KIND_BITS) - 1)) - 1
        w = np.int64(words[s])
        terms = kind >= 0
        ahead = min(place + _AHEAD, len(entries) - 1)
        soon = np.int64(words[entries[ahead] >> KIND_BITS])
        prefetch(gaussians, soon)
        prefetch(gone, soon)
        for k in range(0, 64, _LINE):
            if (sets[ahead] >> np.uint64(k)) & np.uint64((1 << _LINE) - 1):
                prefetch(only, 64 * soon + k)
        ahead = min(place + _NEXT, len(entries) - 1)
        soon = np.int64(words[entries[ahead] >> KIND_BITS])
        coming = sets[ahead]
        first = firsts[soon]
        while coming:
            e = only_of(only[64 * soon + np.int64(lowest(coming))], first)
            coming &= coming - one
            prefetch(arrived, e)
            prefetch(looks, e)
        gain = gains[kind] + logs[place] if terms else 0.0
        rest = sets[place] & ~gone[w] & (gaussians[w] & owed[s] & ~checked[kind, s] if terms else ~gaussians[w])
        while rest:
            low = lowest(rest)
            rest &= rest - one
            g = 64 * w + np.int64(low)
            if not terms:
                size = np.float64(sizes[g]) if varied else size
                if total + size > budget:
                    return place, found, found_terms, dropped, replaced, total
                total += size
                out_gaussians[found] = g
                found += 1
                gaussians[w] |= one << low
                e = only_of(only[g], firsts[w])
                if e >= 0:
                    so_far = arrived[e] + np.int32(only[g] >> 16)
                    if so_far < looks[e]:
                        arrived[e] = so_far
                        continue
                if e != NONE:
                    dropped, replaced = drop_replaced(g, dropped, replaced)
                    rest &= ~gone[w]
                continue
            start = term_offsets[g]
            stop = term_offsets[g + 1]
            kept_back = False
            most = np.float32(-np.inf)
            _look(bodies, g, areas[g], view.pixel, eyes, toward)
            for k in range(start >> 6, (stop + 63) >> 6):
                left = active[k] & ~held_terms[k]
                if 64 * k < start:
                    left &= ones << np.uint64(start & 63)
                if 64 * k + 64 > stop:
                    left &= ones >> np.uint64(64 * k + 64 - stop)
                while left:
                    t = 64 * k + np.int64(lowest(left))
                    if len(eyes) > 0:
                        change = _change(centers, centers_of[t], cosines[t], widths[t], toward)
                        if gain + change < 0.0:
                            left &= left - one
                            kept_back = True
                            most = change if change > most else most
                            continue
                    if total + term_sizes[t] > budget:
                        return place, found, found_terms, dropped, replaced, total
                    total += term_sizes[t]
                    out_terms[found_terms] = t
                    found_terms += 1
                    held_terms[k] |= left & (~left + one)
                    left &= left - one
            if kept_back:
                for k in range(len(gains)):  # kinds with a higher limit need not check it again
                    if gains[k] + logs[place] + most < 0.0:
                        checked[k, s] |= one << low
            else:
                owed[s] &= ~(one << low)
        place += 1
    return place, found, found_terms, dropped, replaced, total
