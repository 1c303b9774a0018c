"""Kernels that plan for one client: rank units by gain. `take` takes the next records that fit.

Loops over all words and units of a cell have no branches, so that they run in SIMD lanes. Whether single Gaussians are
in view is tested only for the words that a plan can reach. Inner loops take arrays one by one, because numba counts
references when it takes arrays out of tuples. Sets, units and buckets are those of `units`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from gsvis._kernels.bits import ones
from gsvis._kernels.compiled import inner, kernel, njit
from gsvis._kernels.prefetch import prefetch
from gsvis.abr._kernels.lanes import not_behind
from gsvis.abr._kernels.units import GEOMETRY, INSIDE, OUTSIDE, STRONG, TERMS, bucket_of

_SAMPLE = 16  # one run in 16 is read to estimate how far to rank
_SPARE = 1.5  # times the wanted bytes, to allow for errors of the estimate
_AHEAD = 3  # words ahead for which spheres are prefetched
_LINE = 16  # float32 values in a cache line
NEVER = 1 << 30  # key of records that are never sent
KIND_BITS = 3  # low bits of an entry: the kind of records
DONE = np.int32(2**31 - 1)  # in `Cell.looks`: the Gaussian is replaced
UNITS = (1 << 16) - 1  # area of all replacements of a Gaussian, the unit of `arrived`, `looks` and `sure`
ANY = np.int32(1 << 26)  # in `Cell.arrived`: how much has arrived is not known
# in the low 16 bits of `Links.only`, as negative numbers
NONE = -1  # replaces no Gaussian
SEVERAL = -2  # replaces several


class Cell(NamedTuple):
    """The candidates of a cell for one client, in S words; E Gaussians of the scene have replacements."""

    words: Any  # (S,) int32 ascending, number of each word
    places: Any  # (6, S) float32, see `Candidates.places`
    term_bytes: Any  # mean bytes of the active terms of a Gaussian that has some
    owed: Any  # (S,) uint64, Gaussians that may have active terms that are not held; (0,) in a scene without terms
    active: Any  # active terms as a packed set
    candidates: Any  # (W,) uint64, all candidates
    allowed: Any  # (S,) uint64, candidates that may be sent now: all, or those that a shell sees
    ahead: Any  # (S,) uint64, what the cell sees that the viewer is about to enter
    checked: Any  # (K, S) or (K, 0) uint64 for each kind of terms, Gaussians that owe none of it for the eye
    checked_at: Any  # (K, S) or (K, 0) float32, `View.travelled` when the first of them were checked
    arrived: Any  # (E,) int32, area of replacements that has arrived, rounded up; from `ANY` on it is unknown
    looks: Any  # (E,) int32, area that must arrive before a Gaussian is checked again among these candidates
    sure: Any  # (E,) int32, area with which it is dropped without a check; 0 where that is unknown
    last: Any  # (N,) uint8, level at which each Gaussian ends
    shares: Any  # (L,) by that level: share of the area of its replacements that must be held before it is dropped


class Held(NamedTuple):
    """What a client holds, as packed sets."""

    gaussians: Any
    terms: Any
    gone: Any  # Gaussians that have been replaced


class View(NamedTuple):
    """What a client looks at."""

    eye: Any  # (3,) float32
    eyes: Any  # (P, 3) float32, only terms that are active for one of them are sent; P = 0 sends all
    travelled: Any  # distance that the eye has moved so far
    # A term is sent if the logarithms of its change, its weight and the root of its solid angle, plus this, exceed 0.
    gains: Any  # (K,) float64 for each kind of terms
    pixel: Any  # steradians that a pixel adds to the solid angle
    parallax: Any  # radians by which a direction changes before terms are checked again
    planes: Any  # (F, 5, 4) float32 frusta
    middle: Any  # (G, 5, 4) float32 smaller frusta: the rest of the view is its edge; G = 0 for a view without edge
    bodies: Any  # (4, 64 W) float32, see `CandidateTables.bodies`


class Limits(NamedTuple):
    """How far to rank."""

    enough: Any  # bytes at which to stop
    least: Any  # lowest key to rank


class Plan(NamedTuple):
    """P entries in the order in which they are sent."""

    entries: Any  # (P,) int32, slot of a word, and in the low `KIND_BITS` bits the kind of records
    sets: Any  # (P,) uint64, Gaussians of the word
    logs: Any  # (P,) float32, logarithm of their blending weight


class Records(NamedTuple):
    """Bytes of all records, and the cones of the terms."""

    sizes: Any  # (N,) bytes of Gaussians, (1,) if all are equal
    term_offsets: Any  # (N + 1,)
    term_sizes: Any  # (T,)
    centers: Any  # (D, 3) float32, see `TermCones`
    places: Any  # (T,) int32
    cosines: Any  # (T,) float32
    widths: Any  # (T,) float32
    areas: Any  # (N,) float32, mean cross-section of each Gaussian


class Links(NamedTuple):
    """Which Gaussians replace which; E are replaced."""

    # Low 16 bits: number in [0, E) of the one Gaussian that is replaced, minus `firsts` of the word; or `NONE` or
    # `SEVERAL`. High 16 bits: area of the replacing Gaussian in `UNITS`, rounded up.
    only: Any  # (N,) uint32
    firsts: Any  # (W,) int32, least number that the Gaussians of a word replace, each just one
    offsets: Any  # (N + 1,) offsets into `ranks`
    ranks: Any  # numbers of all that each Gaussian replaces
    units: Any  # int32 for each of `ranks`: area of the replacing Gaussian in `UNITS`, as in `only`
    ending: Any  # (E,) ids of the replaced Gaussians
    starts: Any  # (E + 1,) offsets into `ids`
    ids: Any  # replacements of each replaced Gaussian
    areas: Any  # float32 for each of `ids`, above 0
    every: Any  # (E,) float64, sum of these areas


@njit(inline="always")
def only_of(only, first):
    """Return the number of the one Gaussian that a Gaussian replaces, `NONE` or `SEVERAL`.

    Args:
        only: Its entry of `Links.only`.
        first: The entry of its word in `Links.firsts`.
    """
    near = np.int64(only & np.uint32(0xFFFF))
    return first + near if near < (1 << 16) + SEVERAL else near - (1 << 16)


class Taken(NamedTuple):
    """Arrays that receive the ids of a batch; see `Batch`."""

    gaussians: Any
    terms: Any
    dropped: Any
    gone: Any


class Work(NamedTuple):
    """Scratch of `rank` for S words, U units, M keys and K kinds of terms."""

    inside: Any  # (S,) uint64
    middle: Any  # (S,) uint64
    free: Any  # (S,) uint64
    due: Any  # (K, S) uint64
    sides: Any  # (S,) uint8
    middle_sides: Any  # (S,) uint8
    squares: Any  # (S,) float32
    border: Any  # (S,) int32
    buckets: Any  # (U,) int32, of `chosen`
    chosen: Any  # (U,) int32
    keys: Any  # (3 (1 + K) U,) int32
    entries: Any  # (3 (1 + K) U,) int32
    sets: Any  # (3 (1 + K) U,) uint64
    owners: Any  # (3 (1 + K) U,) int32
    counts: Any  # (M,) int64
    sizes: Any  # (M,) float64


@kernel(error_model="numpy")
def test_words(x, y, z, radii, p, sides):
    """Set `sides` (S,) to at least 1 where a sphere touches the frustum p (5, 4), and to 2 where it is inside."""
    a0 = p[0, 0]
    b0 = p[0, 1]
    c0 = p[0, 2]
    d0 = p[0, 3]
    a1 = p[1, 0]
    b1 = p[1, 1]
    c1 = p[1, 2]
    d1 = p[1, 3]
    a2 = p[2, 0]
    b2 = p[2, 1]
    c2 = p[2, 2]
    d2 = p[2, 3]
    a3 = p[3, 0]
    b3 = p[3, 1]
    c3 = p[3, 2]
    d3 = p[3, 3]
    a4 = p[4, 0]
    b4 = p[4, 1]
    c4 = p[4, 2]
    d4 = p[4, 3]
    for s in range(len(x)):
        u = x[s]
        v = y[s]
        w = z[s]
        r = radii[s]
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


@inner(error_model="numpy")
def _test_gaussians(words, places, bodies, planes, sides, border, inside):
    """Set `inside` (S,): the Gaussians of each word that are in one of the frusta (F, 5, 4).

    Words with side 2 are inside as a whole. Gaussians of words with side 3 are tested one by one; `border` lists the
    slots that may have side 3.
    """
    xs = bodies[0]
    ys = bodies[1]
    zs = bodies[2]
    sizes = bodies[3]
    x = places[0]
    y = places[1]
    z = places[2]
    radii = places[3]
    for s in range(len(words)):
        inside[s] = ~np.uint64(0) if sides[s] == 2 else np.uint64(0)
    for j in range(len(border)):
        ahead = 64 * np.int64(words[border[min(j + _AHEAD, len(border) - 1)]])
        for k in range(ahead, ahead + 64, _LINE):
            prefetch(xs, k)
            prefetch(ys, k)
            prefetch(zs, k)
            prefetch(sizes, k)
        s = np.int64(border[j])
        if sides[s] != 3:
            continue
        low = 64 * np.int64(words[s])
        bits = np.uint64(0)
        for f in range(len(planes)):
            mine = ~np.uint64(0)
            for k in range(5):
                a = planes[f, k, 0]
                b = planes[f, k, 1]
                c = planes[f, k, 2]
                d = planes[f, k, 3]
                far = a * x[s] + b * y[s] + c * z[s] + d
                if far >= radii[s]:
                    continue  # the whole word is inside this plane
                if far + radii[s] < np.float32(0.0):
                    mine = np.uint64(0)
                    break
                mine &= not_behind(xs, ys, zs, sizes, low, (a, b, c, d))
            bits |= mine
        inside[s] = bits


@njit(inline="always")
def _unsigned(index):
    """Return an int32 index >= 0 as numba takes it without a test of its sign, which would keep loops from vectors."""
    return np.uint64(np.uint32(index))


@inner(error_model="numpy")
def _gather(words, allowed, owed, gaussians, gone, free, due):
    """Set `free` (S,) to Gaussians neither held nor gone, and `due` (S,) to those that owe terms and are not gone."""
    for s in range(len(words)):
        w = _unsigned(words[s])
        free[s] = allowed[s] & ~(gaussians[w] | gone[w])
    for s in range(len(owed)):
        due[s] = allowed[s] & owed[s] & ~gone[_unsigned(words[s])]


@inner(error_model="numpy")
def _skip_checked(squares, travelled, parallax, before, checked, checked_at, due):
    """Set `due` (S,) to the Gaussians of `before` (S,) that are not checked.

    Checks of a word are forgotten if the eye has moved so far that its direction may have changed by the parallax.
    """
    for s in range(len(due)):
        apart = np.float32(travelled) - checked_at[s]
        if checked[s] == 0 or apart * apart > parallax * parallax * squares[s]:
            checked[s] = 0
            checked_at[s] = travelled
        due[s] = before[s] & ~checked[s]


@inner(error_model="numpy")
def _squares(x, y, z, spreads, eye, out):
    """Set `out` (S,) to the mean squared distance of the Gaussians of each word from the eye."""
    a = eye[0]
    b = eye[1]
    c = eye[2]
    for s in range(len(x)):
        u = x[s] - a
        v = y[s] - b
        w = z[s] - c
        out[s] = u * u + v * v + w * w + spreads[s] + np.float32(1e-12)


@inner(error_model="numpy")
def _list_left(slots, masks, rest, out):
    """Write to `out` the units that have Gaussians in `rest` (S,); return their number."""
    count = 0
    for u in range(len(slots)):
        out[count] = u
        count += (masks[u] & rest[_unsigned(slots[u])]) != 0
    return count


@njit(inline="always")
def _key(table, code, kind, part, bucket):
    """Return the sort key of records; for kinds from `STRONG` on, the table has the least key instead of an offset."""
    offset = table[code, kind, part]
    if kind < STRONG:
        return offset + bucket
    geometry = table[code, GEOMETRY, part] + bucket
    return offset if offset > geometry else geometry


@inner(error_model="numpy")
def _estimate_limit(units, runs, cell, table, limits, work):
    """Estimate the key below which about `limits.enough` bytes lie, from a sample of the words."""
    masks = units.masks
    codes = units.codes
    areas = units.areas
    pixels = units.pixels
    squares = work.squares
    starts, run_slots = runs
    free = work.free
    due = work.due
    sides = work.sides
    sizes = work.sizes
    ahead = cell.ahead
    word_bytes = cell.places[5]
    term_bytes = cell.term_bytes
    own = len(table) // 4
    enough, least = limits
    sizes[:] = 0.0
    for r in range(0, len(run_slots), _SAMPLE):
        s = run_slots[r]
        for u in range(starts[r], starts[r + 1]):
            if not masks[u] & (free[s] | due[0, s]):
                continue
            near = ahead[s] if codes[u] >= own else ~np.uint64(0) if sides[s] else np.uint64(0)
            bucket = bucket_of(areas[u] / squares[s] + pixels[u])
            for kind in range(STRONG):
                left = masks[u] & (free[s] if kind == GEOMETRY else due[0, s])
                share = np.float64(word_bytes[s]) if kind == GEOMETRY else term_bytes
                for part in range(2):
                    key = table[codes[u], kind, part] + bucket
                    bits = left & (near if part == INSIDE else ~near)
                    if key < NEVER and bits:
                        sizes[key] += np.float64(ones(bits)) * share
    total = 0.0
    for key in range(least, len(sizes)):
        total += _SAMPLE * sizes[key]
        if total > _SPARE * enough:
            return key + 1
    return len(sizes)


@njit(inline="always")
def _place(code, is_near, shape):
    """Return where the offset of Gaussians of a code lies in the flat table of shape (4 L L, 1 + K, 3)."""
    return np.uint64(shape[1] * shape[2]) * code + np.uint64(INSIDE if is_near else OUTSIDE)


@inner(error_model="numpy")
def _find_keys(units, ahead, table, work, count):
    """Set the first `count` of `work.buckets` and `work.keys`: those of Gaussians and common terms of `work.chosen`.

    The key is that of the Gaussians of a unit if one is left, else that of its terms.
    """
    slots = units.slots
    masks = units.masks
    codes = units.codes
    areas = units.areas
    pixels = units.pixels
    free = work.free
    squares = work.squares
    sides = work.sides
    chosen = work.chosen
    buckets = work.buckets
    keys = work.keys
    own = np.uint64(len(table) // 4)
    shape = table.shape
    parts = np.uint64(shape[2])
    offsets = table.reshape(-1)
    for j in range(count):  # without branches and signed indices, so that it runs in SIMD lanes
        u = _unsigned(chosen[j])
        s = _unsigned(slots[u])
        code = np.uint64(codes[u])
        mask = masks[u]
        is_near = sides[s] != 0 if code < own else (mask & ahead[s]) != 0
        place = _place(code, is_near, shape) + (np.uint64(0) if mask & free[s] else parts)
        bucket = bucket_of(areas[u] / squares[s] + pixels[u])
        buckets[j] = bucket
        keys[j] = offsets[place] + bucket


@inner(error_model="numpy")
def _find_strong_keys(units, ahead, table, work, count):
    """Lower the keys of `_find_keys` where only terms are left, and some of them change the image much."""
    slots = units.slots
    masks = units.masks
    codes = units.codes
    free = work.free
    every = work.due
    sides = work.sides
    chosen = work.chosen
    buckets = work.buckets
    keys = work.keys
    strong = work.inside
    own = np.uint64(len(table) // 4)
    shape = table.shape
    strongest = np.uint64(shape[2]) * np.uint64(min(shape[1] - 1, STRONG))  # the first kind of strong terms
    offsets = table.reshape(-1)
    strong[:] = 0
    for k in range(1, len(every)):
        for s in range(len(strong)):
            strong[s] |= every[k, s]
    for j in range(count):
        u = _unsigned(chosen[j])
        s = _unsigned(slots[u])
        code = np.uint64(codes[u])
        mask = masks[u]
        is_near = sides[s] != 0 if code < own else (mask & ahead[s]) != 0
        place = _place(code, is_near, shape)
        geometry = offsets[place] + buckets[j]
        bound = offsets[place + strongest]
        early = bound if bound > geometry else geometry
        has_strong = ((mask & strong[s]) != 0) & ((mask & free[s]) == 0)
        keys[j] = early if has_strong & (early < keys[j]) else keys[j]


@inner(error_model="numpy")
def _choose(units, ahead, table, limit, work, count):
    """Keep the first `count` units of `work.chosen` that may have a key below `limit`, and compute their buckets.

    Their words on the border of a frustum get side 3 and are listed in `work.border`, for a test of each Gaussian.

    Returns:
        Number of units kept, number of listed words, and whether all units that are left to send were kept.
    """
    slots = units.slots
    codes = units.codes
    own = len(table) // 4
    chosen = work.chosen
    buckets = work.buckets
    keys = work.keys
    sides = work.sides
    middle_sides = work.middle_sides
    _find_keys(units, ahead, table, work, count)
    if len(work.due) > 1:
        _find_strong_keys(units, ahead, table, work, count)
    filled = 0
    skipped = False
    for j in range(count):
        key = keys[j]
        chosen[filled] = chosen[j]
        buckets[filled] = buckets[j]
        filled += key < limit
        skipped |= (key >= limit) & (key < NEVER)
    border = work.border
    listed = 0
    for j in range(filled):
        s = slots[chosen[j]]
        if codes[chosen[j]] < own:
            is_near = (sides[s] == 1) | (middle_sides[s] == 1)
            border[min(listed, len(border) - 1)] = s
            listed += is_near
            sides[s] = 3 if sides[s] == 1 else sides[s]
            middle_sides[s] = 3 if middle_sides[s] == 1 else middle_sides[s]
    return filled, listed, not skipped


@kernel(error_model="numpy")
def rank(units, runs, cell, held, view, table, limits, work):
    """Rank what is left to send by its key: the offset of its code, kind and part, plus the bucket of its gain.

    Args:
        units: `Units` of the cell.
        runs: `Runs` of them.
        cell: `Cell`; outdated entries of `checked` are cleared.
        held: `Held`.
        view: `View`.
        table: (4 L L, 1 + K, 3) int32, see `gsvis.abr.policies.offset_table`.
        limits: `Limits`.
        work: `Work`; see `Scratch.work`.

    Returns:
        `Plan`, the key at which it ends, and whether it has all that is left to send.
    """
    slots = units.slots
    masks = units.masks
    codes = units.codes
    logs = units.logs
    words = cell.words
    places = cell.places
    term_bytes = cell.term_bytes
    inside = work.inside
    middle = work.middle
    free = work.free
    due = work.due
    sides = work.sides
    middle_sides = work.middle_sides
    squares = work.squares
    buckets = work.buckets
    chosen = work.chosen
    keys = work.keys
    entries = work.entries
    sets = work.sets
    owners = work.owners
    counts = work.counts
    sizes = work.sizes
    least = limits.least
    x = places[0]
    y = places[1]
    z = places[2]
    word_bytes = places[5]
    _squares(x, y, z, places[4], view.eye, squares)
    _gather(words, cell.allowed, cell.owed, held.gaussians, held.gone, free, due[0])
    if len(cell.owed):
        for k in range(len(due)):
            _skip_checked(squares, view.travelled, view.parallax, due[0], cell.checked[k], cell.checked_at[k], due[k])
    else:
        due[:] = 0
    for s in range(len(words)):
        middle[s] = free[s] | due[0, s]
    count = _list_left(slots, masks, middle, chosen)
    if count == 0:  # as with each change of the view while a link is filled
        return Plan(np.empty(0, np.int32), np.empty(0, np.uint64), np.empty(0, np.float32)), least, True
    sides[:] = 0
    middle_sides[:] = 0
    for f in range(len(view.planes)):
        test_words(x, y, z, places[3], view.planes[f], sides)
    for f in range(len(view.middle)):
        test_words(x, y, z, places[3], view.middle[f], middle_sides)
    limit = _estimate_limit(units, runs, cell, table, limits, work)
    count, listed, whole = _choose(units, cell.ahead, table, limit, work, count)
    border = work.border[:listed]
    _test_gaussians(words, places, view.bodies, view.planes, sides, border, inside)
    _test_gaussians(words, places, view.bodies, view.middle, middle_sides, border, middle)
    own = len(table) // 4  # codes of ring 0
    counts[:limit] = 0
    sizes[:limit] = 0.0
    filled = 0
    for j in range(count):
        u = chosen[j]
        s = slots[u]
        code = codes[u]
        seen = inside[s] if code < own else cell.ahead[s]
        core = seen & middle[s] if code < own and len(view.middle) > 0 else seen
        for kind in range(1 + len(due)):
            left = masks[u] & (free[s] if kind == GEOMETRY else due[kind - 1, s])
            if not left:
                continue
            share = np.float64(word_bytes[s]) if kind == GEOMETRY else term_bytes if kind == TERMS else 0.0
            for part in range(3):
                bits = left & (core if part == INSIDE else ~seen if part == OUTSIDE else seen & ~core)
                if not bits:
                    continue
                key = _key(table, code, kind, part, buckets[j])
                if key < least or key >= NEVER:
                    continue
                if key >= limit:
                    whole = False
                    continue
                entries[filled] = s << KIND_BITS | kind
                keys[filled] = key
                sets[filled] = bits
                owners[filled] = u
                filled += 1
                counts[key] += 1
                sizes[key] += np.float64(ones(bits)) * share
    total = 0.0
    stop = least
    length = 0
    while stop < limit and total < limits.enough:
        total += sizes[stop]
        counts[stop], length = length, length + counts[stop]
        stop += 1
    plan = Plan(np.empty(length, np.int32), np.empty(length, np.uint64), np.empty(length, np.float32))
    for k in range(filled):
        key = keys[k]
        if key < stop:
            at = counts[key]
            u = owners[k]
            plan.entries[at], plan.sets[at], plan.logs[at] = entries[k], sets[k], logs[u]
            counts[key] += 1
    return plan, stop, whole and length == filled
