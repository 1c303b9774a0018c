"""Kernels that sort projected Gaussians into the lists of tiles.

A list holds the splats that reach alpha 1/255 at a pixel center of the tile, front to back, and now and then one that
does not quite. Threads take chunks of the depth order as they come free; lists do not depend on their number.

Splats are handled in parts, laid out number by number: loops without branches over a part become vectors.
"""

from __future__ import annotations

import numpy as np

from gsvis._kernels.compiled import inner, kernel, uncounted
from gsvis._kernels.prefetch import prefetch
from gsvis._kernels.shared import share, take
from gsvis._kernels.threads import on_numba_threads
from gsvis.render._kernels.lanes import LOG2_255, TILE

__all__ = ["BLOCK", "PART", "SURPLUS", "count_boxes", "fill_tiles", "meet_tiles"]

BLOCK = 1 << 11  # splats that one thread takes at a time
PART = 1 << 8  # splats that are laid out at a time
_MARGIN = 1e-3  # pixels; a surplus tile costs little, a missing tile shows as an edge

_X, _Y, _A, _B, _C, _LEVEL, _HALF_X, _HALF_Y = range(8)
"""Rows of a laid out part: what a splat is made of."""
_LEFT, _RIGHT, _TOP, _BOTTOM = range(8, 12)
"""Its box, in tiles: first and last column, first and last row."""
_BULGE, _SLANT, _NARROWING, _WIDEST = range(12, 16)
"""Its outline; see `_find_boxes`."""
_FIRST = 16
"""The first column of tiles that it reaches in each of its first rows of tiles."""
_COUNT = 20
"""The number of columns there."""
_FEW = _COUNT - _FIRST  # rows of tiles, and columns, that are handled without branches
SURPLUS = _FEW
"""Tiles that may be written behind those of a part."""
_ROWS = _COUNT + _FEW


@uncounted
def _first_tile(low):
    """Return the first tile along an axis with a pixel center at or behind `low`, as a float."""
    return np.ceil((low + 0.5) / TILE) - 1.0


@uncounted
def _last_tile(high):
    """Return the last tile along an axis with a pixel center at or before `high`, as a float."""
    return np.floor((high - 0.5) / TILE)


@uncounted
def _count_under_boxes(block, splats, tiles_x, tiles_y, out):
    """Count the tiles under the boxes of the splats of one block."""
    total = 0.0
    for m in range(block * BLOCK, min(len(splats), (block + 1) * BLOCK)):
        columns = min(_last_tile(splats[m, 0] + splats[m, 6]), tiles_x - 1.0) + 1.0
        columns -= max(_first_tile(splats[m, 0] - splats[m, 6]), 0.0)
        rows = min(_last_tile(splats[m, 1] + splats[m, 7]), tiles_y - 1.0) + 1.0
        rows -= max(_first_tile(splats[m, 1] - splats[m, 7]), 0.0)
        total += max(columns, 0.0) * max(rows, 0.0)
    out[block] = int(total)


@on_numba_threads
@kernel
def count_boxes(splats, tiles_x, tiles_y, out):
    """Write the number of tiles under the boxes of the splats of each block into out (blocks,)."""
    share(_count_under_boxes, len(out), (splats, tiles_x, tiles_y, out))


@uncounted
def _call_up(order, start, end, splats):
    """Let splats along the depth order come into the cache."""
    for k in range(start, end):
        prefetch(splats, 8 * np.int64(order[k]))


@uncounted
def _lay_out(order, start, count, splats, part):
    """Write the numbers of `count` splats along the depth order into the first rows of `part`."""
    for j in range(count):
        m = order[start + j]
        for e in range(8):
            part[e * PART + j] = splats[m, e]


@uncounted(error_model="numpy")
def _find_boxes(part, count, tiles_x, tiles_y):
    """Write the boxes and the outlines of the splats of a part.

    With d = pixel - center, the ellipse on which a splat has alpha 1/255 is a dx^2 + b dx dy + c dy^2 = level. Its
    right side bulges most at dy = `bulge`, and dx = -(slant dy) +- sqrt(narrowing dy^2 + widest).
    """
    for j in range(count):
        x = part[_X * PART + j]
        y = part[_Y * PART + j]
        a = -part[_A * PART + j]
        b = -part[_B * PART + j]
        c = -part[_C * PART + j]
        half_x = part[_HALF_X * PART + j]
        half_y = part[_HALF_Y * PART + j]
        part[_LEFT * PART + j] = max(_first_tile(x - half_x), 0.0)
        part[_RIGHT * PART + j] = min(_last_tile(x + half_x), tiles_x - 1.0)
        part[_TOP * PART + j] = max(_first_tile(y - half_y), 0.0)
        part[_BOTTOM * PART + j] = min(_last_tile(y + half_y), tiles_y - 1.0)
        half = 0.5 / a
        part[_BULGE * PART + j] = -b * half_x / (2.0 * c)
        part[_SLANT * PART + j] = half * b
        part[_NARROWING * PART + j] = (b * b - 4.0 * a * c) * half * half
        part[_WIDEST * PART + j] = (part[_LEVEL * PART + j] + LOG2_255) / a


@uncounted
def _find_span(part, j, row):
    """Return the first column of tiles that a splat of a part reaches in a row of tiles, and the number of columns.

    The right side of an ellipse bulges most where its bounding box touches it, the left side opposite; on a band that
    does not hold that height, it reaches furthest at the nearer line.
    """
    x = part[_X * PART + j]
    y = part[_Y * PART + j]
    half_y = part[_HALF_Y * PART + j]
    low = max(row * TILE + 0.5 - y, -half_y)
    high = min(row * TILE + (TILE - 0.5) - y, half_y)
    bulge = part[_BULGE * PART + j]
    right = min(max(bulge, low), high)
    left = min(max(-bulge, low), high)
    slant = part[_SLANT * PART + j]
    narrowing = part[_NARROWING * PART + j]
    widest = part[_WIDEST * PART + j]
    nearest = x - slant * left - np.sqrt(max(narrowing * left * left + widest, 0.0))
    furthest = x - slant * right + np.sqrt(max(narrowing * right * right + widest, 0.0))
    first = max(part[_LEFT * PART + j], _first_tile(nearest - _MARGIN))
    last = min(part[_RIGHT * PART + j], _last_tile(furthest + _MARGIN))
    return first, last - first + 1.0


@uncounted(error_model="numpy")
def _find_spans(part, count):
    """Write what the splats of a part reach in each of their first rows of tiles."""
    for k in range(_FEW):
        for j in range(count):
            first, columns = _find_span(part, j, part[_TOP * PART + j] + k)
            part[(_FIRST + k) * PART + j] = first
            part[(_COUNT + k) * PART + j] = columns


@uncounted
def _count_boxes(part, count):
    """Return the number of tiles under the boxes of the splats of a part."""
    total = 0.0
    for j in range(count):
        columns = part[_RIGHT * PART + j] - part[_LEFT * PART + j] + 1.0
        rows = part[_BOTTOM * PART + j] - part[_TOP * PART + j] + 1.0
        total += max(columns, 0.0) * max(rows, 0.0)
    return int(total)


@uncounted
def _write_row(met, at, tile, columns):
    """Write neighboring tiles into met from `at` on, and up to three behind them; return where they end."""
    for k in range(_FEW):
        met[at + k] = tile + k
    for k in range(_FEW, columns):
        met[at + k] = tile + k
    return at + columns


@uncounted
def _write_tiles(part, count, tiles_x, met, at, changes, spans, first):
    """Write the tiles of the splats of a part into met from `at` on, and the number of each splat's tiles into spans.

    A row of tiles adds 1 to `changes` (tiles_y, tiles_x + 1) where it begins, and takes it where it ends.
    """
    for j in range(count):
        before = at
        top = int(part[_TOP * PART + j])
        for k in range(int(part[_BOTTOM * PART + j]) - top + 1):
            if k < _FEW:
                column = int(part[(_FIRST + k) * PART + j])
                columns = int(part[(_COUNT + k) * PART + j])
            else:
                begin, width = _find_span(part, j, part[_TOP * PART + j] + k)
                column = int(begin)
                columns = int(width)
            if columns > 0:
                at = _write_row(met, at, (top + k) * tiles_x + column, columns)
                changes[top + k, column] += 1
                changes[top + k, column + columns] -= 1
        spans[first + j] = at - before


@uncounted
def _add_up(changes, counts):
    """Add the sums of changes (tiles_y, tiles_x + 1) along rows to counts (tiles,)."""
    tiles_y, columns = changes.shape
    tile = 0
    for row in range(tiles_y):
        total = 0
        for column in range(columns - 1):
            total += changes[row, column]
            counts[tile] += total
            tile += 1


@uncounted
def _parts_of(chunk, chunks, splats):
    """Return the first part of a chunk and the first behind it, of a number of splats."""
    parts = (splats + PART - 1) // PART
    return parts * chunk // chunks, parts * (chunk + 1) // chunks


@inner(error_model="numpy")
def _meet_chunk(chunk, order, splats, tiles_x, tiles_y, taken, met, starts, spans, counts, pairs):
    """Write the tiles that the splats of one chunk reach; see `meet_tiles`."""
    part = np.empty(_ROWS * PART)
    changes = np.zeros((tiles_y, tiles_x + 1), np.int32)
    begin, end = _parts_of(chunk, len(counts), len(order))
    total = 0
    _call_up(order, begin * PART, min((begin + 1) * PART, len(order)), splats)
    for k in range(begin, end):
        first = k * PART
        count = min(PART, len(order) - first)
        _lay_out(order, first, count, splats, part)
        _call_up(order, first + count, min(first + count + PART, len(order)), splats)
        _find_boxes(part, count, tiles_x, tiles_y)
        _find_spans(part, count)
        starts[k] = take(taken, _count_boxes(part, count) + SURPLUS)
        _write_tiles(part, count, tiles_x, met, starts[k], changes, spans, first)
        for j in range(count):
            total += spans[first + j]
    _add_up(changes, counts[chunk])
    pairs[chunk] = total


@on_numba_threads
@kernel
def meet_tiles(order, splats, tiles_x, tiles_y, taken, met, starts, spans, counts, pairs):
    """Write the tiles that each splat reaches into met, those of a part of the depth order one behind the other.

    Args:
        order: (M,) int32 splats, front to back.
        splats: (M, 8) float64.
        tiles_x: Number of tiles across.
        tiles_y: Number of tiles down.
        taken: (1,) int64, how much of `met` is in use.
        met: (P,) int32, room for the tiles under all boxes, and for `SURPLUS` more for each part.
        starts: (parts,) int64, receives where the tiles of each part start.
        spans: (M,) int32, receives the number of tiles of each splat along the depth order.
        counts: (chunks, tiles) int32, to which the splats of each chunk in each tile are added.
        pairs: (chunks,) int64, receives their sums.
    """
    share(_meet_chunk, len(counts), (order, splats, tiles_x, tiles_y, taken, met, starts, spans, counts, pairs))


@uncounted
def _fill_chunk(chunk, order, starts, spans, met, places, pairs, members, pair_of, first_pair):
    """Write the splats of one chunk into the tiles' lists; see `fill_tiles`."""
    begin, end = _parts_of(chunk, len(places), len(order))
    pair = pairs[chunk]
    for part in range(begin, end):
        at = starts[part]
        for k in range(part * PART, min((part + 1) * PART, len(order))):
            first_pair[k] = pair
            for _ in range(spans[k]):
                tile = met[at]
                at += 1
                place = places[chunk, tile]
                places[chunk, tile] = place + 1
                members[place] = order[k]
                if len(pair_of):
                    pair_of[place] = pair
                pair += 1


@on_numba_threads
@kernel
def fill_tiles(order, starts, spans, met, places, pairs, members, pair_of, first_pair):
    """Write each tile's list, front to back, from places (chunks, tiles) on, which are counted up.

    `starts`, `spans` and `met` are those of `meet_tiles`; `pairs` (chunks,) is the number of the first pair of each
    chunk. `pair_of` (may be empty) numbers the pairs along the depth order: splat order[k] owns those from
    first_pair[k] on.
    """
    share(_fill_chunk, len(places), (order, starts, spans, met, places, pairs, members, pair_of, first_pair))
