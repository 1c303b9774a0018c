"""Kernels that splat Gaussians front to back onto the six faces around an eye, one square of 64 x 64 pixels at a time.

Squares are independent, so each free thread takes the next one. A square keeps one bit for each pixel that has light
left. Clusters are splatted nearest first, in rounds. A cluster, a Gaussian or a row of pixels is skipped if no pixel
under it has light left. Skipping changes no result. Faces as in `sphere.py`.

A blurred splat is wider than its Gaussian. It takes only the share of a pixel's light that the Gaussian covers, the
ratio of the two areas; else splats smaller than a pixel would close the gaps between them. Its weight is the geometric
mean of what the Gaussian takes, which a ray finds, and of what the blurred splat takes, which an image shows.

Gaussians that are known, or too small to be found, only take light. Specks among them are thinned: one of 2, 4, 8 or 16
neighbors takes the light of all (Cook et al. 2007, "Stochastic simplification of aggregate detail").
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from gsvis._kernels.bits import bits_of, lowest
from gsvis._kernels.compiled import inner, kernel, uncounted
from gsvis._kernels.prefetch import prefetch
from gsvis._kernels.shared import raise_to, take_next
from gsvis._kernels.threads import in_threads
from gsvis.hpr._kernels import project as table
from gsvis.hpr._kernels.block import (
    HEIGHT,
    LANES,
    RECORD,
    STRIDE,
    blend_bands,
    find_bands,
    rows_with_light,
    take_largest,
)
from gsvis.hpr._kernels.keys import BELOW, PLACES, STANDS, row_of, sort_keys
from gsvis.hpr._kernels.reach import CLUSTER, PLACED, find_reaching

SQUARE = 64
_ROUND = 256  # Gaussians collected for a square before the nearest are splatted
_LAST_COLUMN, _FIRST_ROW, _LAST_ROW, _DISTANCE, _COVER = (np.uint64(k * LANES) for k in range(1, PLACED))
_ONE = np.float32(1.0)
_HALF = np.float32(0.5)
_NONE = np.uint64(0)
_ALL = np.uint64(2**64 - 1)
_MOST_STANDS = 4
_SPECKS = np.float32(0.25)  # most of a pixel's light that a speck may take for others
_FORM = np.uint64(6)  # numbers of a record before the share of the weight that is taken, and the distance
_BANDS = np.int64(2**32 - 1)  # the part of a block's word that holds its bands
_X = np.int64(32)  # bits of a block's word below its column, its row and the column of its Gaussian
_Y = np.int64(40)
_K = np.int64(48)
_BLOCKS = 64  # blocks that are found before the Gaussians of all are blended
_MOST_BLOCKS = (SQUARE // LANES) ** 2  # of a Gaussian


class Brush(NamedTuple):
    """Room for the Gaussians that are splatted together, `COLUMNS` of `project.py`.

    Attributes:
        given: (ROWS * COLUMNS,) float32 and
        forms: (FORMS * COLUMNS,) float64, as in `project.py`.
        records: (RECORD * 64,) float32, the records of blocks; see `block.py`.
        blocks: (64,) int64, the words of blocks: bands, column and row in the square, column of the Gaussian.
        places: (COLUMNS,) int64, where the result of each Gaussian goes in `best`; negative for nowhere.
        most: (32 * COLUMNS,) float32, zeros, the largest weight and light of each Gaussian, lane by lane.
        deep: Whether depths are kept.
    """

    given: Any
    forms: Any
    records: Any
    blocks: Any
    places: Any
    most: Any
    deep: bool


@inner
def _column_mask(first, last):
    """Return a mask with the bits first..last set."""
    return (_ALL >> np.uint64(63 - (last - first))) << np.uint64(first)


@uncounted
def _any_lit(lit, x0, x1, y0, y1):
    """Return whether a pixel of a rectangle has light left."""
    pixels = _column_mask(x0, x1)
    found = _NONE
    for y in range(y0, y1 + 1, LANES):
        rows = _ALL >> np.uint64(64 - min(y1 + 1 - y, LANES))
        found |= rows_with_light(lit, pixels, y) & rows
    return found != _NONE


@inner
def _enlarge(keys, count):
    """Return a copy of the first `count` keys in an array of twice the length."""
    out = np.empty(2 * len(keys), np.uint64)
    for k in range(min(count, len(keys))):
        out[k] = keys[k]
    return out


@uncounted
def _frame_box(lit, extent, corner):
    """Return the first and last column, and the first and last row, with light in the square, as pixels of the face."""
    found = _NONE
    y0 = np.int64(extent[1])
    y1 = np.int64(-1)
    for y in range(extent[1]):
        if lit[y] != _NONE:
            found |= lit[y]
            y0 = min(y0, y)
            y1 = y
    x0 = np.int64(lowest(found))
    x1 = extent[0] - 1
    while (found >> np.uint64(x1)) & np.uint64(1) == _NONE:
        x1 -= 1
    column = corner[0] + _HALF
    row = corner[1] + _HALF
    return column + np.float32(x0), column + np.float32(x1), row + np.float32(y0), row + np.float32(y1)


@inner
def _is_known(known, row):
    """Return whether a row is known."""
    return (known[np.uint64(row) >> np.uint64(6)] >> (np.uint64(row) & np.uint64(63))) & np.uint64(1) != _NONE


@inner
def _stands_for(cover):
    """Return the power of two of specks of this cover for which one may stand."""
    power = 0
    while power < _MOST_STANDS and np.float32(2 << power) * cover <= _SPECKS:
        power += 1
    return power


@uncounted
def _load_row(near, covars, ids, i):
    """Start to load what `project` reads of Gaussian i, and its number."""
    prefetch(near, 8 * i)
    prefetch(covars, 6 * i)
    prefetch(covars, 6 * i + 5)
    prefetch(ids, i)


@uncounted
def _meet(scene, sought, eye, face, corner, extent, half, c, lit, box, placed, keys, held):
    """Add the members of cluster c that may reach a lit pixel of the square to the keys; return their number.

    A key holds the bits of the squared distance, the power of two of specks for which the member stands, and the row.
    No lit pixel lies outside `box`.
    """
    near, covars, columns, ids = scene
    known, least = sought
    axis = face >> 1
    au = 1 if axis == 0 else 0
    av = 1 if axis == 2 else 2
    sign = np.float32(1.0 - 2.0 * (face & 1))
    axes = (axis, au, av)
    toward = (sign, eye[axis], eye[au], eye[av])
    point = (eye[0], eye[1], eye[2])
    frame = (corner[0], corner[1], np.float32(extent[0] - 1), np.float32(extent[1] - 1))
    for first in range(0, CLUSTER, LANES):
        reaching = find_reaching(columns, c * 5 * CLUSTER + first, axes, toward, point, half, box, frame, placed)
        while reaching != _NONE:
            lane = lowest(reaching)
            k = first + np.int64(lane)
            reaching &= reaching - np.uint64(1)
            stands = 0
            if least > np.float32(0.0):
                cover = placed[lane + _COVER]
                if _is_known(known, c * CLUSTER + k) or cover < least * least:
                    stands = _stands_for(cover)
                    if k & ((1 << stands) - 1) != 0:
                        continue
            x0 = np.int64(placed[lane])
            x1 = np.int64(placed[lane + _LAST_COLUMN])
            y0 = np.int64(placed[lane + _FIRST_ROW])
            y1 = np.int64(placed[lane + _LAST_ROW])
            if x0 > x1 or y0 > y1 or not _any_lit(lit, x0, x1, y0, y1):
                continue
            row = np.uint64(c * CLUSTER + k) | (np.uint64(stands) << STANDS)
            keys[held] = (bits_of(placed[lane + _DISTANCE]) << BELOW) | row
            _load_row(near, covars, ids, c * CLUSTER + k)
            held += 1
    return held


@uncounted
def _find_blocks(brush, k, lit, count):
    """Add the blocks of a square in which light meets the Gaussian in column k of a table; return their number."""
    given = brush.given
    forms = brush.forms
    records = brush.records
    x0 = np.int64(given[k + table.X0])
    x1 = np.int64(given[k + table.X1])
    y0 = np.int64(given[k + table.Y0])
    y1 = np.int64(given[k + table.Y1])
    if x0 > x1 or y0 > y1:
        return count
    px = np.float64(given[k + table.PX])
    py = np.float64(given[k + table.PY])
    top = np.float64(given[k + table.TOP])
    qa = forms[k]
    qb = forms[k + table.B]
    qc = forms[k + table.C]
    for y in range(y0, y1 + 1, LANES):
        dy = y + 0.5 - py
        for x in range(x0, x1 + 1, LANES):
            dx = x + 0.5 - px
            form = (
                np.float32((qa * dx + qb * dy) * dx + qc * dy * dy + top),
                np.float32(2.0 * qa * dx + qb * dy),
                np.float32(2.0 * qc * dy + qb * dx),
                np.float32(qa),
                np.float32(qb),
                np.float32(qc),
            )
            at = np.uint64(RECORD * count)
            for j in range(_FORM):
                records[at + j] = form[j]
            records[at + _FORM] = given[k + table.TAKEN]
            records[at + _FORM + np.uint64(1)] = given[k + table.FAR]
            bands = find_bands(lit, form, x, y, min(y1 + 1 - y, LANES))
            brush.blocks[np.uint64(count)] = bands | x << _X | y << _Y | np.int64(k) << _K
            count += bands != 0  # a branch could not be foreseen
    return count


@uncounted
def _blend(square, lit, brush, count, spent):
    """Blend Gaussians into the first `count` blocks, in order; return the number of pixels whose light they end."""
    darkened = 0
    for n in range(count):
        block = brush.blocks[np.uint64(n)]
        bands = block & _BANDS
        x = block >> _X & 63
        y = block >> _Y & 63
        k = block >> _K
        darkened += blend_bands(square, lit, brush.records, n, bands, x, y, spent, brush.most, k, brush.deep)
    return darkened


@uncounted
def _raise_best(brush, count, spent, best):
    """Raise the results of the first `count` Gaussians of a table, and empty `brush.most`."""
    given = brush.given
    for k in range(np.uint64(count)):
        given[k + table.X0] = take_largest(brush.most, np.int64(2 * k)) * given[k + table.ROOT]
        given[k + table.X1] = take_largest(brush.most, np.int64(2 * k) + 1)
    for k in range(np.uint64(count)):
        weight = given[k + table.X0]
        clear = given[k + table.X1]
        place = brush.places[k]
        if place >= 0 and clear >= spent:
            if weight > best[place]:
                raise_to(best, place, weight)
            if clear > best[place + 1]:
                raise_to(best, place + 1, clear)


@uncounted
def _open(square, lit, extent):
    """Give light to the pixels of a square, and none to those around it; return their number."""
    for y in range(SQUARE):
        lit[y] = _column_mask(np.int64(0), extent[0] - 1) if y < extent[1] else _NONE
        for x in range(STRIDE):
            square[0, y, x] = _ONE if x < extent[0] and y < extent[1] else np.float32(0.0)
            square[1, y, x] = np.inf
    return extent[0] * extent[1]


@uncounted
def _is_reached(rectangles, count, corner, extent):
    """Return whether one of the first `count` rectangles of clusters meets a square."""
    column = np.int64(corner[0])
    line = np.int64(corner[1])
    for k in range(count):
        place = rectangles[k]
        if place[0] < column + extent[0] and place[1] >= column and place[2] < line + extent[1] and place[3] >= line:
            return True
    return False


@uncounted
def _load_cluster(columns, c):
    """Start to load the members of cluster c."""
    for line in range(0, 5 * CLUSTER, 16):
        prefetch(columns, c * 5 * CLUSTER + line)


@uncounted
def _collect(scene, sought, eye, face, corner, extent, half, nearest, rectangles, order, lit, placed, keys, at, held):
    """Add members of the next clusters to the keys, until there are enough for a round or no room is left.

    Args:
        scene: As in `splat_squares`.
        sought: As in `splat_squares`.
        eye: (3,) float32.
        face: Number of the face.
        corner: First column and row of the square.
        extent: Columns and rows of the square.
        half: Half the side of the face.
        nearest: (B,) float32.
        rectangles: (B, 4) int16, where the clusters in `order` lie on this face.
        order: Clusters of the face, nearest first.
        lit: Rows of the square that have light.
        placed: Room for `find_reaching`.
        keys: (K,) uint64, extended in place.
        at: The next place in `order`.
        held: Number of keys.

    Returns:
        The next place in `order`, the number of keys, and the least key that a later cluster may add.
    """
    column = np.int64(corner[0])
    line = np.int64(corner[1])
    first = held
    box = _frame_box(lit, extent, corner)
    loading = np.int64(-1)  # a cluster that is being loaded; the one before it is met meanwhile
    horizon = _ALL
    while at < len(order):
        place = np.uint64(at)
        x0 = max(rectangles[place, 0] - column, 0)
        x1 = min(rectangles[place, 1] - column, extent[0] - 1)
        y0 = max(rectangles[place, 2] - line, 0)
        y1 = min(rectangles[place, 3] - line, extent[1] - 1)
        if x0 > x1 or y0 > y1:
            at += 1
            continue
        c = order[place]
        if held - first >= _ROUND or held + 2 * CLUSTER > len(keys):
            horizon = bits_of(nearest[c]) << BELOW
            break
        at += 1
        if _any_lit(lit, x0, x1, y0, y1):
            _load_cluster(scene[2], c)
            if loading >= 0:
                held = _meet(scene, sought, eye, face, corner, extent, half, loading, lit, box, placed, keys, held)
            loading = c
    if loading >= 0:
        held = _meet(scene, sought, eye, face, corner, extent, half, loading, lit, box, placed, keys, held)
    return at, held, horizon


@uncounted
def _divide(keys, held, horizon, ready):
    """Move the keys below `horizon` to `ready`; return the numbers of keys that stay and that moved."""
    kept = np.int64(0)
    chosen = np.int64(0)
    for k in range(np.uint64(held)):
        key = keys[k]
        ready[np.uint64(chosen)] = key
        keys[np.uint64(kept)] = key
        moved = key < horizon  # a branch could not be foreseen
        chosen += moved
        kept += 1 - moved
    return kept, chosen


@uncounted
def _splat_all(scene, sought, eye, face, corner, extent, half, spent, keys, count, square, lit, brush, best, left):
    """Splat the Gaussians of the first `count` keys in order; return the number of pixels that have light left."""
    near, covars, _, ids = scene
    known, least = sought
    sign = np.float32(1.0 - 2.0 * (face & 1))
    for first in range(0, count, table.COLUMNS):
        some = min(count - first, table.COLUMNS)
        for k in range(first + table.COLUMNS, min(first + 2 * table.COLUMNS, count)):
            _load_row(near, covars, ids, row_of(keys[k]))
        table.gather(near, covars, eye, face, keys, first, some, brush.given)
        table.project(sign, corner, extent, half, brush.given, brush.forms)
        found = np.int64(0)
        for k in range(some):
            row = row_of(keys[first + k])
            place = np.int64(-1)
            if least <= np.float32(0.0) or not _is_known(known, row):
                place = 2 * ids[row]
                prefetch(best, place)
            brush.places[k] = place
            found = _find_blocks(brush, np.uint64(k), lit, found)
            if found > _BLOCKS - _MOST_BLOCKS:
                left -= _blend(square, lit, brush, found, spent)
                found = np.int64(0)
        left -= _blend(square, lit, brush, found, spent)
        _raise_best(brush, some, spent, best)
        if left == 0:
            return left
    return left


@inner
def _fill(
    scene, sought, eye, face, corner, extent, half, spent, nearest, rectangles, order, square, lit, brush, room, best
):
    """Splat the clusters in `order` onto one square until no light is left. Returns the working arrays, perhaps grown.

    `room` is (waiting, ready, spare, tally, placed): keys of Gaussians that farther ones may still precede, arrays to
    sort in, and that of `find_reaching`.
    """
    waiting, ready, spare, tally, placed = room
    # literals would compile what is called twice
    left = _open(square, lit, extent)
    held = np.int64(0)
    at = np.int64(0)
    while left > 0 and (at < len(order) or held > 0):
        if held + _ROUND + 2 * CLUSTER > len(waiting):
            waiting = _enlarge(waiting, held)
        at, held, horizon = _collect(
            scene, sought, eye, face, corner, extent, half, nearest, rectangles, order, lit, placed, waiting, at, held
        )
        while len(ready) < held:
            ready = _enlarge(ready, held)
            spare = _enlarge(spare, held)
        held, chosen = _divide(waiting, held, horizon, ready)
        if sort_keys(ready, spare, tally, chosen):
            ready, spare = spare, ready
        left = _splat_all(
            scene, sought, eye, face, corner, extent, half, spent, ready, chosen, square, lit, brush, best, left
        )
    return waiting, ready, spare, tally, placed


@uncounted
def _keep(square, extent, x, y, fold, light, depths):
    """Write the light of a square that begins at (x, y), and the largest depths of blocks of its pixels, of a face."""
    if light.shape[0] > 0:
        for row in range(extent[1]):
            for column in range(extent[0]):
                light[y + row, x + column] = square[0, row, column]
    for row in range(extent[1]):
        if row % fold != 0:
            for column in range(np.uint64(SQUARE)):
                most = square[1, row - row % fold, column]
                square[1, row - row % fold, column] = max(most, square[1, row, column])
    for row in range(0, extent[1], fold):
        for column in range(0, extent[0], fold):
            most = square[1, row, column]
            for k in range(column + 1, min(column + fold, extent[0])):
                most = max(most, square[1, row, k])
            depths[(y + row) // fold, (x + column) // fold] = most


@in_threads(lambda scene, sought, eye, size, *_: 6 * ((size + SQUARE - 1) // SQUARE) ** 2)
@kernel(error_model="numpy")
def splat_squares(
    taken, scene, sought, eye, size, spent, nearest, rectangles, lists, counts, wanted, best, fold, light, depths
):
    """Splat front to back all that each face may see, in the squares that are wanted.

    Args:
        taken: (1,) int64, counter of the squares taken; callers omit it.
        scene: `near`, `covars`, `columns` and `ids` of the `Splats`.
        sought: What is looked for: (B,) uint64 for each cluster, bit k set if its member k is known, so that its weight
            does not count; and float32, the least weight that counts. Specks that do not count are thinned, and what
            is known is not found; 0 thins nothing and finds all.
        eye: (3,) float32.
        size: S.
        spent: float32.
        nearest: (B,) float32, bound of the squared distance of each cluster.
        rectangles: (6, B, 4) int16, where each cluster of `lists` lies.
        lists: (6, B) int64, the clusters of each face, nearest first.
        counts: (6,) int64, number of clusters of each face.
        wanted: (6, T, T) bool, squares to splat, by face, row and column; others keep their light.
        best: (2 N,) float32, zeros; receives for each Gaussian the largest share of a pixel's light that it takes and
            the largest light in front, over pixels that are not spent.
        fold: Pixels along a side of a block of `depths`, a power of two up to 64.
        light: (6, S, S) float32, receives the light left behind everything, or the first value below `spent`; (6, 0, 0)
            keeps none.
        depths: (6, D, D) float32, D = ceil(S / fold), inf; receives the largest distance in each block of pixels at
            which light fell below `spent`, or inf; (6, 0, 0) keeps none.
    """
    side = (size + SQUARE - 1) // SQUARE
    turn = take_next(taken)
    if turn >= 6 * side * side:
        return
    square = np.zeros((2, HEIGHT, STRIDE), np.float32)
    lit = np.zeros(SQUARE + LANES, np.uint64)
    sorting = np.empty(PLACES + 1, np.int64), np.empty(PLACED * LANES, np.float32)
    room = np.empty(2048, np.uint64), np.empty(2048, np.uint64), np.empty(2048, np.uint64), sorting[0], sorting[1]
    brush = Brush(
        np.zeros(table.ROWS * table.COLUMNS, np.float32),
        np.zeros(table.FORMS * table.COLUMNS),
        np.empty(RECORD * _BLOCKS, np.float32),
        np.empty(_BLOCKS, np.int64),
        np.empty(table.COLUMNS, np.int64),
        np.zeros(2 * LANES * table.COLUMNS, np.float32),
        depths.shape[1] > 0,
    )
    corner = np.empty(2, np.float32)
    extent = np.empty(2, np.int64)
    while turn < 6 * side * side:
        face = turn // (side * side)
        x = turn % side * SQUARE
        y = turn // side % side * SQUARE
        corner[0] = x
        corner[1] = y
        extent[0], extent[1] = min(size - x, SQUARE), min(size - y, SQUARE)
        if not wanted[face, turn // side % side, turn % side]:
            turn = take_next(taken)
            continue
        if light.shape[1] == 0 and not _is_reached(rectangles[face], counts[face], corner, extent):
            turn = take_next(taken)
            continue
        room = _fill(
            scene,
            sought,
            eye,
            face,
            corner,
            extent,
            np.float32(0.5 * size),
            spent,
            nearest,
            rectangles[face],
            lists[face, : counts[face]],
            square,
            lit,
            brush,
            room,
            best,
        )
        if depths.shape[1] > 0:
            _keep(square, extent, x, y, fold, light[face], depths[face])
        turn = take_next(taken)


@kernel
def take_found(best):
    """Return the Gaussians that light reaches (K,), ascending, and their values (2, K); reset `best` (2 N,) to 0."""
    found = best.view(np.uint64)  # two values at a time
    count = 0
    for i in range(len(found)):
        count += found[i] != _NONE
    ids = np.empty(count, np.int64)
    values = np.empty((2, count), np.float32)
    at = 0
    for i in range(len(found)):
        if found[i] != _NONE:
            ids[at], values[0, at], values[1, at] = i, best[2 * i], best[2 * i + 1]
            best[2 * i] = 0.0
            best[2 * i + 1] = 0.0
            at += 1
    return ids, values


@kernel
def pack_known(known, ids, words):
    """Write for each cluster of rows a word (B,) with bit k set if Gaussian ids[64 b + k] is known (N,)."""
    for b in range(len(words)):
        word = _NONE
        first = np.uint64(b * CLUSTER)
        for k in range(np.uint64(min(CLUSTER, len(ids) - b * CLUSTER))):
            word |= np.uint64(known[np.uint64(ids[first + k])]) << k
        words[b] = word
