"""Kernels that encode and decode records of Gaussians, 16 bytes each.

The table that codes a field is chosen by the fields before it. Gaussians of a chunk are sorted by strength, so the
strength of the record before, with the opacity and the shape, predicts the largest scale. All arithmetic is in
integers, so that all clients get the same records. Decoding never raises, and every decoded record can be drawn.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gsvis._kernels.compiled import inner, kernel
from gsvis._kernels.prefetch import prefetch
from gsvis._kernels.records import put, take, weight
from gsvis._kernels.rounding import TURNS, place_limit, turn_bits
from gsvis.stream._kernels.coder import LEAST, RAW, begin, next_bits, next_symbol, push_bits, push_symbol, put_states

MOST_OPERATIONS = 17  # most operations of the coder for a record
ROW = 16  # fields of a record, see `split`

# Numbers of tables: one table for each of these,
OPACITY, ORDER, MIDDLE, SMALLEST, FIRST = range(5)
LARGEST = 5  # six tables: by the distance of the id before
ROTATION = 11  # for each of three components, `TURNS` tables: by the bits that are not sent
COLOR = ROTATION + 3 * TURNS  # one table
SECOND = COLOR + 1  # eight tables: by the first component
THIRD = COLOR + 9  # 17 tables: by the second component
FOURTH = COLOR + 26  # eight tables: by the first component
TABLES = COLOR + 34  # number of tables

STEPS = 64  # symbols of the largest scale; after the last one the scale follows in raw bits
BELOW = 47  # symbol 0 stands for the predicted scale minus this


class Layout(NamedTuple):
    """Layout of the records of a scene, for kernels.

    Attributes:
        position: Bits of a coordinate.
        rotation: Bits of a component of the quaternion.
        scale: Bits of a log-scale.
        colors: Bytes of the base color, 3 or 4.
        coarse: Whether some bits are not sent.
        place: Limit of the steps of coordinates, 1/64 octaves; see `place_limit`.
        turn: Limit of the steps of the quaternion, 1/64 octaves; see `turn_bits`.
        logs: (256,) int32, 64 log2 of an opacity of 0 to 255.
        sums: (S,) int32, 64 log2(1 + 2^(-i / 64)).
        before: (256,) int32, the table for the third component of a color, by the value of the second.
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


@inner(forceinline=True)
def _distance_table(distance):
    """Return which of the `LARGEST` tables codes the largest scale: 0 for the next id, 5 for 32 ids away or more."""
    octave = (np.float64(distance).view(np.int64) >> 52) - 1023  # log2 without a loop, whose branches are slow
    return max(min(octave, 5), 0)


@inner(forceinline=True)
def _split_record(low, high, row, chunks, layout, offsets, s, out):
    """Write to `out` (ROW,) the fields of a record that do not depend on the record before; `s` (3,) is scratch.

    These are opacity and order, the differences of the scales, the largest scale, the symbols of the quaternion and of
    the color, the coordinates, and the strength in two halves.
    """
    position = layout.position
    rotation = layout.rotation
    scale = layout.scale
    width = position + rotation + scale
    head = 8 * (1 + layout.colors)
    lead = 1 if layout.colors == 3 else 2
    half = (1 << (rotation - 1)) - 1
    opacity = np.int64(low & np.uint64(255))
    stride = chunks.strides[row]
    for k in range(3):
        s[k] = take(low, high, head + k * width + position + rotation, scale)
    largest = 0 if s[0] >= s[1] and s[0] >= s[2] else (1 if s[1] >= s[2] else 2)
    a = 1 if largest == 0 else 0
    b = 1 if largest == 2 else 2
    order = 2 * largest
    if s[a] < s[b]:
        a, b, order = b, a, order + 1
    middle = s[largest] - s[a]
    smallest = s[largest] - s[b]
    size = chunks.lows[row] + s[largest] * stride
    turn = turn_bits(size, middle * stride, layout.turn) if layout.coarse else np.int64(0)
    out[0], out[1], out[2], out[3] = opacity | order << 8, middle, smallest, s[largest]
    for k in range(3):
        value = ((take(low, high, head + k * width + position, rotation) - half) >> turn) + half
        out[4 + k] = offsets[ROTATION + TURNS * k + turn] + value
    first = np.int64((low >> np.uint64(8 * (1 + lead))) & np.uint64(255))
    out[7] = offsets[COLOR] + first
    second = np.int64(0)
    out[10] = 0
    for k in range(layout.colors):
        if k == lead:
            continue
        place = k if k < lead else k - 1
        value = np.int64((low >> np.uint64(8 * (1 + k))) & np.uint64(255))
        if layout.colors == 3:
            value = (value - first) & 255
        if place == 0:
            out[8] = offsets[SECOND + (first >> 5)] + value
            second = value
        elif place == 1:
            out[9] = offsets[THIRD + layout.before[second]] + value
        else:
            out[10] = offsets[FOURTH + (first >> 5)] + value
    for k in range(3):
        out[11 + k] = take(low, high, head + k * width, position)
    strength = 2 * size + weight(middle, smallest, opacity, stride, layout.logs, layout.sums)
    out[14] = strength & 0xFFFF
    out[15] = (strength >> 16) & 0xFFFF


@kernel
def split(words, rows, chunks, layout, offsets, out):
    """Split records into the fields that do not depend on the record before, to encode them many times.

    Args:
        words: (N, 2) uint64, the records.
        rows: (N,) int32, row of the chunk of each.
        chunks: Rows of chunks.
        layout: Layout of the records.
        offsets: (TABLES + 1,) int64, first symbol of each table, at most 2^16.
        out: (N, ROW) uint16, receives the fields.
    """
    s = np.empty(3, np.int64)
    for i in range(len(words)):
        _split_record(words[i, 0], words[i, 1], rows[i], chunks, layout, offsets, s, out[i])


@inner(forceinline=True)
def _strength(low, high):
    """Return a strength from its two halves of 16 bits."""
    return np.int64(np.int32(np.uint32(low) | np.uint32(high) << np.uint32(16)))


@inner(forceinline=True)
def _scale_symbol(top, expected, most):
    """Return the symbol of the largest scale of a record; `STEPS` - 1 if raw bits follow.

    Args:
        top: The largest scale.
        expected: The scale that the strength of the record before it in its chunk predicts.
        most: Largest value of a scale.
    """
    off = top - min(max(expected, 0), most) + BELOW
    return off if 0 <= off < STEPS - 1 else np.int64(STEPS - 1)


@inner(forceinline=True)
def _inverse(stride):
    """Return 2^36 over a stride of 1 to 255, rounded up, for `_divide`."""
    return ((np.uint64(1) << np.uint64(36)) - np.uint64(1)) // np.uint64(stride) + np.uint64(1)


@inner(forceinline=True)
def _divide(value, stride, inverse):
    """Return floor(value / stride) without a division, for values of less than 2^18 strides."""
    above = np.uint64(value + (stride << 18))
    return np.int64((above * inverse) >> np.uint64(36)) - (1 << 18)


@kernel
def operations(parts, ids, rows, chunks, layout, offsets, out):
    """Write the operations of the coder for each record, in the order of decoding.

    Args:
        parts: (G, ROW) uint16 from `split`.
        ids: (G,) int64, ascending.
        rows: (G,) int32, row of the chunk of each.
        chunks: Rows of chunks.
        layout: Layout of the records.
        offsets: (TABLES + 1,) int64, first symbol of each table.
        out: (MOST_OPERATIONS G,) uint32, receives the operations, see `coder.write`.

    Returns:
        The number of operations.
    """
    lows = chunks.lows
    strides = chunks.strides
    steps = chunks.steps
    at = 0
    bits = chunks.bits
    most = (1 << layout.scale) - 1
    for i in range(len(parts)):
        row = rows[i]
        top = np.int64(parts[i, 3])
        before = i - 1
        low = lows[row]
        stride = strides[row]
        out[at] = offsets[OPACITY] + (parts[i, 0] & 255)
        out[at + 1] = offsets[ORDER] + (parts[i, 0] >> 8)
        out[at + 2] = offsets[MIDDLE] + parts[i, 1]
        out[at + 3] = offsets[SMALLEST] + parts[i, 2]
        at += 4
        if i == 0 or row != rows[i - 1]:
            out[at] = offsets[FIRST] + top
        else:
            mine = _strength(parts[i, 14], parts[i, 15])
            other = _strength(parts[before, 14], parts[before, 15])
            strong = mine - 2 * (low + top * stride)
            symbol = _scale_symbol(top, (((other - strong) >> 1) - low) // stride, most)
            out[at] = offsets[LARGEST + _distance_table(ids[i] - ids[i - 1])] + symbol
            if symbol == STEPS - 1:
                at += 1
                out[at] = RAW | (layout.scale << 16) | top
        at += 1
        for k in range(4, 7 + layout.colors):
            out[at] = parts[i, k]
            at += 1
        limit = np.int64(0)
        opacity = np.int64(parts[i, 0]) & 255
        if layout.coarse:
            long = np.int64(parts[i, 1]) * stride
            limit = place_limit(low + top * stride, long, opacity, layout.place, layout.logs)
        for k in range(3):
            left = bits[row, k]
            if layout.coarse:
                left -= min(max(limit - steps[row, k], 0), left)
            if left:
                out[at] = RAW | (left << 16) | (np.int64(parts[i, 11 + k]) >> (bits[row, k] - left))
                at += 1
    return at


@kernel
def write(parts, ids, rows, chunks, layout, offsets, inverses, spans, out):
    """Encode records, in one pass from the last to the first; the result of `coder.write` for their `operations`.

    Operations use two states in turn. After an operation that not every record has, the states are swapped.

    Args:
        parts: (N, ROW) uint16 from `split`, all records of a scene.
        ids: (G,) int32, ascending: the records to write.
        rows: (G,) int32, row of the chunk of each.
        chunks: Rows of chunks.
        layout: Layout of the records.
        offsets: (TABLES + 1,) int64, first symbol of each table.
        inverses: See `coder.write`.
        spans: See `coder.write`.
        out: uint16, at least four words longer than the operations.

    Returns:
        The place of the first word.
    """
    steps = chunks.steps
    flat = parts.reshape(-1)
    widths = chunks.bits
    most = (1 << layout.scale) - 1
    # the states of the next operation and of the one after it
    x = np.uint64(LEAST)
    y = np.uint64(LEAST)
    at = len(out)
    before = np.int64(-1)
    low = np.int64(0)
    stride = np.int64(1)
    inverse = np.uint64(0)
    to_smallest = np.uint64(offsets[SMALLEST])
    to_middle = np.uint64(offsets[MIDDLE])
    to_order = np.uint64(offsets[ORDER])
    to_opacity = np.uint64(offsets[OPACITY])
    for i in range(len(ids) - 1, -1, -1):
        prefetch(flat, ROW * np.int64(ids[max(i - 8, 0)]))
        # unsigned, so that no index is checked for its sign
        g = np.uint64(ids[i])
        row = np.uint64(rows[i])
        if rows[i] != before:
            before = np.int64(rows[i])
            low = chunks.lows[row]
            stride = chunks.strides[row]
            inverse = _inverse(stride)
        top = np.int64(parts[g, 3])
        opacity = np.int64(parts[g, 0]) & 255
        limit = np.int64(0)
        if layout.coarse:
            long = np.int64(parts[g, 1]) * stride
            limit = place_limit(low + top * stride, long, opacity, layout.place, layout.logs)
        for k in range(2, -1, -1):
            wide = widths[row, k]
            cut = min(max(limit - steps[row, k], 0), wide) if layout.coarse else np.int64(0)
            if wide > cut:
                z, at = push_bits(np.int64(parts[g, 11 + k]) >> cut, wide - cut, x, at, out)
                x = y
                y = z
        if layout.colors == 4:
            z, at = push_symbol(np.uint64(parts[g, 10]), x, at, inverses, spans, out)
            x = y
            y = z
        x, at = push_symbol(np.uint64(parts[g, 9]), x, at, inverses, spans, out)
        y, at = push_symbol(np.uint64(parts[g, 8]), y, at, inverses, spans, out)
        x, at = push_symbol(np.uint64(parts[g, 7]), x, at, inverses, spans, out)
        y, at = push_symbol(np.uint64(parts[g, 6]), y, at, inverses, spans, out)
        x, at = push_symbol(np.uint64(parts[g, 5]), x, at, inverses, spans, out)
        y, at = push_symbol(np.uint64(parts[g, 4]), y, at, inverses, spans, out)
        symbol = offsets[FIRST] + top
        if i > 0 and rows[i] == rows[i - 1]:
            f = np.uint64(ids[i - 1])
            mine = _strength(parts[g, 14], parts[g, 15])
            other = _strength(parts[f, 14], parts[f, 15])
            strong = mine - 2 * (low + top * stride)
            symbol = _scale_symbol(top, _divide(((other - strong) >> 1) - low, stride, inverse), most)
            if symbol == STEPS - 1:
                z, at = push_bits(top, layout.scale, x, at, out)
                x = y
                y = z
            symbol += offsets[LARGEST + _distance_table(ids[i] - ids[i - 1])]
        x, at = push_symbol(np.uint64(symbol), x, at, inverses, spans, out)
        y, at = push_symbol(to_smallest + np.uint64(parts[g, 2]), y, at, inverses, spans, out)
        x, at = push_symbol(to_middle + np.uint64(parts[g, 1]), x, at, inverses, spans, out)
        y, at = push_symbol(to_order + np.uint64(parts[g, 0] >> 8), y, at, inverses, spans, out)
        x, at = push_symbol(to_opacity + np.uint64(opacity), x, at, inverses, spans, out)
        x, y = y, x
    return put_states(y, x, at, out)


@kernel
def read(words, ids, rows, chunks, layout, code, out):
    """Decode records; return whether the words are valid and have nothing else.

    Args:
        words: (W,) uint16.
        ids: (G,) int64, ascending.
        rows: (G,) int32, row of the chunk of each.
        chunks: Rows of chunks.
        layout: Layout of the records.
        code: Tables of the scene.
        out: (G, 2) uint64, receives the records.
    """
    position = layout.position
    rotation = layout.rotation
    scale = layout.scale
    width = position + rotation + scale
    head = 8 * (1 + layout.colors)
    lead = 1 if layout.colors == 3 else 2
    mask = (np.int64(1) << scale) - 1
    half = (np.int64(1) << (rotation - 1)) - 1
    if len(words) < 4:
        return False
    slots = code.slots
    tables = code.rows
    offsets = code.offsets
    spans = code.spans
    (x, y), at = begin(words), 4
    before = -1
    strength = np.int64(0)
    last = np.int64(0)
    s = np.empty(3, np.int64)
    bits = np.empty(2, np.uint64)
    for i in range(len(out)):
        if at > len(words):
            return False
        row = rows[i]
        stride = chunks.strides[row]
        opacity, x, y, at = next_symbol(words, x, y, at, np.int64(OPACITY), slots, tables, offsets, spans)
        order, x, y, at = next_symbol(words, x, y, at, np.int64(ORDER), slots, tables, offsets, spans)
        middle, x, y, at = next_symbol(words, x, y, at, np.int64(MIDDLE), slots, tables, offsets, spans)
        smallest, x, y, at = next_symbol(words, x, y, at, np.int64(SMALLEST), slots, tables, offsets, spans)
        strong = weight(middle, smallest, opacity, stride, layout.logs, layout.sums)
        if row != before:
            top, x, y, at = next_symbol(words, x, y, at, np.int64(FIRST), slots, tables, offsets, spans)
        else:
            table = LARGEST + _distance_table(ids[i] - last)
            top, x, y, at = next_symbol(words, x, y, at, table, slots, tables, offsets, spans)
            if top == STEPS - 1:
                top, x, y, at = next_bits(words, x, y, at, scale)
            else:
                expected = (((strength - strong) >> 1) - chunks.lows[row]) // stride
                top = (min(max(expected, 0), mask) + top - BELOW) & mask
        size = chunks.lows[row] + top * stride
        before = row
        last = ids[i]
        strength = 2 * size + strong
        largest = order >> 1
        a = 1 if largest == 0 else 0
        b = 1 if largest == 2 else 2
        if order & 1:
            a, b = b, a
        s[largest] = top
        s[a] = (top - middle) & mask
        s[b] = (top - smallest) & mask
        bits[0], bits[1] = np.uint64(opacity), np.uint64(0)
        turn = turn_bits(size, middle * stride, layout.turn) if layout.coarse else np.int64(0)
        for k in range(3):
            value, x, y, at = next_symbol(words, x, y, at, ROTATION + TURNS * k + turn, slots, tables, offsets, spans)
            value = (((value - half) << turn) + half) & ((1 << rotation) - 1)
            put(bits, head + k * width + position, value)
            put(bits, head + k * width + position + rotation, s[k])
        first, x, y, at = next_symbol(words, x, y, at, np.int64(COLOR), slots, tables, offsets, spans)
        put(bits, 8 * (1 + lead), first)
        base = first if layout.colors == 3 else 0
        value, x, y, at = next_symbol(words, x, y, at, SECOND + (first >> 5), slots, tables, offsets, spans)
        put(bits, np.int64(8), (value + base) & 255)
        value, x, y, at = next_symbol(words, x, y, at, THIRD + layout.before[value], slots, tables, offsets, spans)
        put(bits, 8 * (4 - lead), (value + base) & 255)
        if layout.colors == 4:
            value, x, y, at = next_symbol(words, x, y, at, FOURTH + (first >> 5), slots, tables, offsets, spans)
            put(bits, np.int64(32), value)
        limit = place_limit(size, middle * stride, opacity, layout.place, layout.logs)
        for k in range(3):
            left = chunks.bits[row, k]
            if layout.coarse:
                left -= min(max(limit - chunks.steps[row, k], 0), left)
            value, x, y, at = next_bits(words, x, y, at, left)
            put(bits, head + k * width, value << (chunks.bits[row, k] - left))
        out[i, 0], out[i, 1] = bits[0], bits[1]
    return at == len(words) and x == np.uint64(LEAST) and y == np.uint64(LEAST)
