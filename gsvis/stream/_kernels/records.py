"""Kernels of coded records: what the coder does for each record of 16 bytes, and back.

A field is coded by a table that the fields before it choose. Gaussians of a chunk are sorted by strength, so the
strength of the record before, with the opacity and the shape, predicts the largest scale. All arithmetic is of
integers, so that any client gets the same records. Decoding never raises; any records that it returns can be drawn.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gsvis._kernels.records import put, take, weight
from gsvis.stream._kernels.coder import LEAST, RAW, begin, next_bits, next_symbol

_OPTIONS: dict[str, Any] = {"cache": True, "nogil": True}

MOST_OPERATIONS = 17  # of a record

OPACITY, ORDER, MIDDLE, SMALLEST, FIRST = range(5)  # tables
LARGEST = 5  # and the six after it: by how far the id before is away
ROTATION = 11  # three times TURNS
TURNS = 8
COLOR = ROTATION + 3 * TURNS  # then the second component by the first, the third by the second, the fourth by the first
SECOND, THIRD, FOURTH = COLOR + 1, COLOR + 9, COLOR + 26
TABLES = COLOR + 34

STEPS = 64  # symbols of the largest scale; the last is for any other distance
BELOW = 47  # distance of symbol 0 below the prediction


class Layout(NamedTuple):
    """What kernels know of the records of a scene.

    Attributes:
        position: Bits of a coordinate.
        rotation: Bits of a component of the quaternion.
        scale: Bits of a log-scale.
        colors: Bytes of the base color, 3 or 4.
        coarse: Whether bits are left out.
        place: Limit of the steps of coordinates, 1/64 octaves; see `_place_limit`.
        turn: Limit of the steps of the quaternion, 1/64 octaves; see `_turn`.
        logs: (256,) int32, 64 log2 of an opacity of 0 to 255.
        sums: (S,) int32, 64 log2(1 + 2^(-i / 64)).
        before: (256,) int32, which table codes the third component of a color after this difference.
    """

    position: int
    rotation: int
    scale: int
    colors: int
    coarse: bool
    place: int
    turn: int
    logs: NDArray[np.int32]
    sums: NDArray[np.int32]
    before: NDArray[np.int32]


class Rounding(NamedTuple):
    """Bits of the opacity, of the ratios of the scales, and of each byte of the color that `coarsen` rounds."""

    opacity: int
    shape: int
    color: int


class Chunks(NamedTuple):
    """Rows of chunks as kernels need them: (C,) int64 lows and strides, (C, 3) int64 log2 of steps, rounded up."""

    lows: NDArray[np.int64]
    strides: NDArray[np.int64]
    steps: NDArray[np.int64]


@njit(inline="always")
def _place_limit(size, middle, opacity, stride, layout):
    """Return log2 of the longest step of a coordinate: less for long and opaque Gaussians, at most the middle scale."""
    long = middle * stride
    return min(layout.place - (long >> 1) - layout.logs[opacity], size - long) >> 6


@njit(inline="always")
def _turn(size, middle, stride, layout):
    """Return how many bits of the quaternion are left out: fewer for large and for long Gaussians."""
    if not layout.coarse:
        return 0
    return min(max((layout.turn - (2 * size + middle * stride) // 4) >> 6, 0), TURNS - 1)


@njit(inline="always")
def _gap(distance):
    """Return which table codes the largest scale: 0 for neighbors, 5 for 32 ids away or more."""
    k = 0
    while k < 5 and distance >> (k + 1):
        k += 1
    return k


@njit(**_OPTIONS)
def operations(words, ids, rows, chunks, layout, offsets, out):
    """Write what the coder does for each record, in the order of decoding.

    Args:
        words: (G, 2) uint64, the records.
        ids: (G,) int64, ascending.
        rows: (G,) int32, row of the chunk of each.
        chunks: Rows of chunks.
        layout: Layout of the records.
        offsets: (TABLES + 1,) int64, first symbol of each table.
        out: (MOST_OPERATIONS G,) uint32, receives the numbers of symbols, counted over all tables, or raw bits: RAW,
            their number from bit 16 on, and the bits.

    Returns:
        The number of operations.
    """
    position, rotation, scale = layout.position, layout.rotation, layout.scale
    width, head = position + rotation + scale, 8 * (1 + layout.colors)
    lead, half = 1 if layout.colors == 3 else 2, (1 << (rotation - 1)) - 1
    at, before, strength, last = 0, -1, np.int64(0), np.int64(0)
    s, p = np.empty(3, np.int64), np.empty(3, np.int64)
    for i in range(len(words)):
        low, high, row = words[i, 0], words[i, 1], rows[i]
        opacity, stride = np.int64(low & np.uint64(255)), chunks.strides[row]
        for k in range(3):
            s[k] = take(low, high, head + k * width + position + rotation, scale)
        largest = 0 if s[0] >= s[1] and s[0] >= s[2] else (1 if s[1] >= s[2] else 2)
        a, b = (1 if largest == 0 else 0), (1 if largest == 2 else 2)
        order = 2 * largest
        if s[a] < s[b]:
            a, b, order = b, a, order + 1
        middle, smallest = s[largest] - s[a], s[largest] - s[b]
        out[at] = offsets[OPACITY] + opacity
        out[at + 1] = offsets[ORDER] + order
        out[at + 2] = offsets[MIDDLE] + middle
        out[at + 3] = offsets[SMALLEST] + smallest
        at += 4
        strong = weight(middle, smallest, opacity, stride, layout.logs, layout.sums)
        if row != before:
            out[at] = offsets[FIRST] + s[largest]
            at += 1
        else:
            expected = (((strength - strong) >> 1) - chunks.lows[row]) // stride
            off = s[largest] - min(max(expected, 0), (1 << scale) - 1) + BELOW
            table = offsets[LARGEST + _gap(ids[i] - last)]
            if 0 <= off < STEPS - 1:
                out[at] = table + off
            else:
                out[at] = table + STEPS - 1
                at += 1
                out[at] = RAW | (scale << 16) | s[largest]
            at += 1
        size = chunks.lows[row] + s[largest] * stride
        before, last, strength = row, ids[i], 2 * size + strong
        turn = _turn(size, middle, stride, layout)
        for k in range(3):
            value = ((take(low, high, head + k * width + position, rotation) - half) >> turn) + half
            out[at] = offsets[ROTATION + TURNS * k + turn] + value
            at += 1
        first = np.int64((low >> np.uint64(8 * (1 + lead))) & np.uint64(255))
        for k in range(layout.colors):
            p[0] = np.int64((low >> np.uint64(8 * (1 + k))) & np.uint64(255))
            if k == lead:
                continue
            place = k if k < lead else k - 1
            value = p[0]
            if layout.colors == 3:
                value = (p[0] - first) & 255
            if place == 0:
                out[at + 1] = offsets[SECOND + (first >> 5)] + value
                p[1] = value
            elif place == 1:
                out[at + 2] = offsets[THIRD + layout.before[p[1]]] + value
            else:
                out[at + 3] = offsets[FOURTH + (first >> 5)] + value
        out[at] = offsets[COLOR] + first
        at += layout.colors
        limit = _place_limit(size, middle, opacity, stride, layout)
        for k in range(3):
            left = position
            if layout.coarse:
                left -= min(max(limit - chunks.steps[row, k], 0), position)
            if left:
                value = take(low, high, head + k * width, position) >> (position - left)
                out[at] = RAW | (left << 16) | value
                at += 1
    return at


@njit(**_OPTIONS)
def read(words, ids, rows, chunks, layout, code, out):
    """Write the records that words hold, and return whether the words are such records and nothing else.

    Args:
        words: (W,) uint16.
        ids: (G,) int64, ascending.
        rows: (G,) int32, row of the chunk of each.
        chunks: Rows of chunks.
        layout: Layout of the records.
        code: Tables of the scene.
        out: (G, 2) uint64.
    """
    position, rotation, scale = layout.position, layout.rotation, layout.scale
    width, head = position + rotation + scale, 8 * (1 + layout.colors)
    lead, mask = 1 if layout.colors == 3 else 2, (np.int64(1) << scale) - 1
    half = (np.int64(1) << (rotation - 1)) - 1
    if len(words) < 4:
        return False
    slots, tables, offsets, spans = code.slots, code.rows, code.offsets, code.spans
    (x, y), at = begin(words), 4
    before, strength, last = -1, np.int64(0), np.int64(0)
    s, bits = np.empty(3, np.int64), np.empty(2, np.uint64)
    for i in range(len(out)):
        if at > len(words):
            return False
        row = rows[i]
        stride = chunks.strides[row]
        opacity, x, y, at = next_symbol(words, x, y, at, OPACITY, slots, tables, offsets, spans)
        order, x, y, at = next_symbol(words, x, y, at, ORDER, slots, tables, offsets, spans)
        middle, x, y, at = next_symbol(words, x, y, at, MIDDLE, slots, tables, offsets, spans)
        smallest, x, y, at = next_symbol(words, x, y, at, SMALLEST, slots, tables, offsets, spans)
        strong = weight(middle, smallest, opacity, stride, layout.logs, layout.sums)
        if row != before:
            top, x, y, at = next_symbol(words, x, y, at, FIRST, slots, tables, offsets, spans)
        else:
            table = LARGEST + _gap(ids[i] - last)
            top, x, y, at = next_symbol(words, x, y, at, table, slots, tables, offsets, spans)
            if top == STEPS - 1:
                top, x, y, at = next_bits(words, x, y, at, scale)
            else:
                expected = (((strength - strong) >> 1) - chunks.lows[row]) // stride
                top = (min(max(expected, 0), mask) + top - BELOW) & mask
        size = chunks.lows[row] + top * stride
        before, last, strength = row, ids[i], 2 * size + strong
        largest = order >> 1
        a, b = (1 if largest == 0 else 0), (1 if largest == 2 else 2)
        if order & 1:
            a, b = b, a
        s[largest], s[a], s[b] = top, (top - middle) & mask, (top - smallest) & mask
        bits[0], bits[1] = np.uint64(opacity), np.uint64(0)
        turn = _turn(size, middle, stride, layout)
        for k in range(3):
            value, x, y, at = next_symbol(words, x, y, at, ROTATION + TURNS * k + turn, slots, tables, offsets, spans)
            value = (((value - half) << turn) + half) & ((1 << rotation) - 1)
            put(bits, head + k * width + position, value)
            put(bits, head + k * width + position + rotation, s[k])
        first, x, y, at = next_symbol(words, x, y, at, COLOR, slots, tables, offsets, spans)
        put(bits, 8 * (1 + lead), first)
        base = first if layout.colors == 3 else 0
        value, x, y, at = next_symbol(words, x, y, at, SECOND + (first >> 5), slots, tables, offsets, spans)
        put(bits, 8, (value + base) & 255)
        value, x, y, at = next_symbol(words, x, y, at, THIRD + layout.before[value], slots, tables, offsets, spans)
        put(bits, 8 * (4 - lead), (value + base) & 255)
        if layout.colors == 4:
            value, x, y, at = next_symbol(words, x, y, at, FOURTH + (first >> 5), slots, tables, offsets, spans)
            put(bits, 32, value)
        limit = _place_limit(size, middle, opacity, stride, layout)
        for k in range(3):
            left = position
            if layout.coarse:
                left -= min(max(limit - chunks.steps[row, k], 0), position)
            value, x, y, at = next_bits(words, x, y, at, left)
            put(bits, head + k * width, value << (position - left))
        out[i, 0], out[i, 1] = bits[0], bits[1]
    return at == len(words) and x == np.uint64(LEAST) and y == np.uint64(LEAST)


@njit(**_OPTIONS)
def coarsen(words, rows, chunks, layout, rounding, out):
    """Write records without the bits that a coarse layout leaves out.

    Args:
        words: (N, 2) uint64, records.
        rows: (N,) int32, row of the chunk of each.
        chunks: Rows of chunks.
        layout: Layout of the records.
        rounding: Other bits that are rounded.
        out: (N, 2) uint64, receives the records.
    """
    position, rotation, scale = layout.position, layout.rotation, layout.scale
    width, head = position + rotation + scale, 8 * (1 + layout.colors)
    s, bits = np.empty(3, np.int64), np.empty(2, np.uint64)
    half = (1 << (rotation - 1)) - 1
    for i in range(len(words)):
        low, high, row = words[i, 0], words[i, 1], rows[i]
        stride = chunks.strides[row]
        opacity = _round(np.int64(low & np.uint64(255)), rounding.opacity, 0, 255)
        for k in range(3):
            s[k] = take(low, high, head + k * width + position + rotation, scale)
        top = max(s[0], s[1], s[2])
        middle, smallest = top, np.int64(0)
        for k in range(3):  # shapes relative to the largest, which stays
            s[k] = top - _round(top - s[k], rounding.shape, 0, top)
            smallest = max(smallest, top - s[k])
        middle = 3 * top - s[0] - s[1] - s[2] - smallest
        bits[0], bits[1] = np.uint64(opacity), np.uint64(0)
        size = chunks.lows[row] + top * stride
        turn = _turn(size, middle, stride, layout)
        limit = _place_limit(size, middle, opacity, stride, layout)
        for k in range(layout.colors):
            color = np.int64((low >> np.uint64(8 * (1 + k))) & np.uint64(255))
            put(bits, 8 * (1 + k), _round(color, rounding.color, 0, 255))
        for k in range(3):
            at = head + k * width
            left_out = min(max(limit - chunks.steps[row, k], 0), position)
            put(bits, at, _round(take(low, high, at, position), left_out, 0, (1 << position) - 1))
            put(bits, at + position, _round(take(low, high, at + position, rotation), turn, half, 2 * half + 1))
            put(bits, at + position + rotation, s[k])
        out[i, 0], out[i, 1] = bits[0], bits[1]


@njit(inline="always")
def _round(value, bits, center, most):
    """Return the nearest value, from 0 to `most`, that is a multiple of 2^bits away from the center; ties to even."""
    step = np.int64(1) << bits
    away = value - center
    found = (away + (step >> 1)) >> bits
    if bits and away & (step - 1) == step >> 1 and found & 1:
        found -= 1
    found = center + found * step
    if found > most:
        found -= step
    elif found < 0:
        found += step
    return found
