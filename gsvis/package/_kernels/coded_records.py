"""Kernel of coded records: one function writes and reads the records of a part, field by field.

Gaussians of a chunk are sorted by strength, so the strength of the one before, with the opacity and the shape, predicts
the largest scale. The upper bits of a place are coded as a path through an octree of the chunk's box, with
probabilities by how many earlier Gaussians took each branch. The lower bits are noise and are stored uncoded. Bits that
rounded records lack are neither coded nor stored. All arithmetic is in integers.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gsvis._kernels.compiled import inner, kernel, njit
from gsvis._kernels.records import put, take, weight
from gsvis._kernels.rounding import (
    MOST_ROUNDED,
    TURNS,
    Limits,
    bits_to_round,
    light_of,
    place_limit,
    turn_bits,
)
from gsvis.package._kernels.adaptive import START, begin, code_raw, code_tree, end

DEPTH = 12  # bits of the path in the octree
STEPS = 6  # bits of the largest scale minus its prediction; the highest value means that the scale follows whole
BELOW = 47  # value 0 stands for the prediction minus this
_GRADES = 10  # grades of counts, see `_grade`
_CONTEXTS = 16 + 128 + 8  # contexts of the second, third and fourth component of a color
_CLASSES = 1 + MOST_ROUNDED  # numbers of bits that a value may lack
_ORDERS = 256 * _CLASSES  # probabilities of opacity, which come first
_SHAPE = _ORDERS + 64  # those of opacity and order
_ONE, _THREE, _EIGHT, _STEPS = np.array([1, 3, 8, STEPS])
"""Numbers with a type: numba would compile the called function again for each literal."""

# indices of the fields of a record
_OPACITY = 0
_ORDER = 1
_MIDDLE = 2
_SMALLEST = 3
_TOP = 4
_ROTATION = 5
_COLOR = 8
_PATH = 12
_FIELDS = 13


class Fields(NamedTuple):
    """Layout of records, for the kernel.

    Attributes:
        position: Bits of a coordinate.
        rotation: Bits of a component of the quaternion.
        scale: Bits of a log-scale.
        colors: Bytes of the base color, 3 or 4.
        counts: Bits of the number of terms, 0 to 8.
        coarse: Whether records are rounded.
        limits: How they are rounded.
        logs: (256,) int32, 64 log2 of an opacity of 0 to 255.
        sums: (S,) int32, 64 log2(1 + 2^(-i / 64)).
    """

    position: int
    rotation: int
    scale: int
    colors: int
    counts: int
    coarse: bool
    limits: Limits
    logs: NDArray[np.int32]
    sums: NDArray[np.int32]


class Rows(NamedTuple):
    """Rows of C chunks.

    Attributes:
        lows: (C,) int64, see `ChunkTable`.
        strides: (C,) int64, see `ChunkTable`.
        counts: (C,) int64, numbers of Gaussians.
        steps: (C, 3) int64, see `Chunks`.
        bits: (C, 3) int64, bits of places.
    """

    lows: NDArray[np.int64]
    strides: NDArray[np.int64]
    counts: NDArray[np.int64]
    steps: NDArray[np.int64]
    bits: NDArray[np.int64]


@njit(inline="always")
def _grade(count):
    """Return the grade of a count, 0 to 9: the count itself below 6, then in wider and wider steps."""
    if count < 6:
        return count
    return 6 if count < 9 else 7 if count < 14 else 8 if count < 24 else 9


@inner(forceinline=True)
def _code_path(low, span, at, chances, start, path, nodes, stamp, data, writing):
    """Write or read a path of DEPTH bits through the octree of a chunk; return the path and the state of the coder.

    Args:
        low: State of the coder, as `span` and `at`; see `code_tree`.
        span: See `low`.
        at: See `low`.
        chances: Probabilities.
        start: First of DEPTH * 100 probabilities.
        path: The path; ignored when reading.
        nodes: (2^DEPTH, 3) int64: for each node the number of the chunk, and how many Gaussians took each branch.
        stamp: Number of the chunk; nodes with a different number are empty.
        data: The words.
        writing: Whether to write.
    """
    node = np.int64(1)
    for depth in range(DEPTH):
        if nodes[node, 0] != stamp:
            nodes[node, 0] = stamp
            nodes[node, 1] = 0
            nodes[node, 2] = 0
        place = start + (depth * _GRADES + _grade(nodes[node, 1])) * _GRADES + _grade(nodes[node, 2])
        way = path >> (DEPTH - 1 - depth) & 1
        bit, low, span, at = code_tree(low, span, at, chances, place - 1, way, _ONE, data, writing)
        nodes[node, 1 + bit] += 1
        node = node << 1 | bit
    return node - (1 << DEPTH), low, span, at


@inner
def _take_record(words, i, fields, wide, v, low_bits):
    """Split record i: write its fields to `v`, and the lower bits of its places, of `wide` (3,) bits, to `low_bits`."""
    position = fields.position
    rotation = fields.rotation
    scale = fields.scale
    levels = DEPTH // 3
    width = position + rotation + scale
    head = 8 * (1 + fields.colors)
    first = words[i, 0]
    last = words[i, 1]
    v[_OPACITY] = np.int64(first & np.uint64(255))
    for k in range(fields.colors):
        v[_COLOR + k] = np.int64((first >> np.uint64(8 * (1 + k))) & np.uint64(255))
    bit = head + position + rotation
    x = take(first, last, bit, scale)
    y = take(first, last, bit + width, scale)
    z = take(first, last, bit + 2 * width, scale)
    largest = 0 if x >= y and x >= z else (1 if y >= z else 2)
    top, a, b = (x, y, z) if largest == 0 else ((y, x, z) if largest == 1 else (z, x, y))
    v[_ORDER] = 2 * largest + np.int64(a < b)
    v[_TOP] = top
    v[_MIDDLE], v[_SMALLEST] = top - max(a, b), top - min(a, b)
    v[_PATH] = 0
    for k in range(3):
        place = take(first, last, head + k * width, position)
        v[_ROTATION + k] = take(first, last, head + k * width + position, rotation)
        below = max(wide[k] - levels, 0)
        low_bits[i, k] = place & ((1 << below) - 1)
        upper = (place >> below) << max(levels - wide[k], 0)
        for level in range(levels):
            v[_PATH] |= (upper >> (levels - 1 - level) & 1) << (DEPTH - 1 - 3 * level - k)


@inner
def _put_record(words, i, fields, wide, v, low_bits, bits):
    """Assemble record i from its fields `v` and `low_bits`; `bits` (2,) uint64 is scratch."""
    position = fields.position
    rotation = fields.rotation
    scale = fields.scale
    levels = DEPTH // 3
    width = position + rotation + scale
    head = 8 * (1 + fields.colors)
    mask = (np.int64(1) << scale) - 1
    bits[0], bits[1] = np.uint64(v[_OPACITY]), np.uint64(0)
    for k in range(fields.colors):
        put(bits, 8 * (1 + k), v[_COLOR + k])
    largest = min(v[_ORDER] >> 1, 2)
    top = v[_TOP]
    a = 1 if largest == 0 else 0
    b = 1 if largest == 2 else 2
    if v[_ORDER] & 1:
        a, b = b, a
    for k in range(3):
        place = np.int64(0)
        for level in range(levels):
            place = place << 1 | (v[_PATH] >> (DEPTH - 1 - 3 * level - k) & 1)
        place = place >> max(levels - wide[k], 0) << max(wide[k] - levels, 0)
        put(bits, head + k * width, place | np.int64(low_bits[i, k]))
        put(bits, head + k * width + position, v[_ROTATION + k])
        below = 0 if k == largest else (v[_MIDDLE] if k == a else v[_SMALLEST])
        put(bits, head + k * width + position + rotation, (top - below) & mask)
    words[i, 0], words[i, 1] = bits[0], bits[1]


@inner(forceinline=True)
def _code_component(low, span, at, chances, tree, component, tint, data, writing):
    """Write or read a component of a color modulo 256, which lacks `tint` bits; return it and the state."""
    value = (component & 255) >> tint
    value, low, span, at = code_tree(low, span, at, chances, tree, value, _EIGHT - tint, data, writing)
    return value << tint, low, span, at


@inner
def _code_color(low, span, at, chances, start, c, colors, tint, data, writing):
    """Write or read the components c of a base color, which lack `tint` bits, and return the state of the coder.

    Of three components the second is coded first, and the others as differences from it. Of four, the third is first.
    """
    start = start + 256 * (1 + _CONTEXTS) * tint
    lead = 1 if colors == 3 else 2
    c[lead], low, span, at = _code_component(low, span, at, chances, start, c[lead], tint, data, writing)
    base = c[lead] if colors == 3 else 0
    start += 256
    tree = start + 256 * (c[lead] >> 4)
    second, low, span, at = _code_component(low, span, at, chances, tree, c[0] - base, tint, data, writing)
    start += 256 * 16
    tree = start + 256 * (second >> 1)
    third, low, span, at = _code_component(low, span, at, chances, tree, c[3 - lead] - base, tint, data, writing)
    start += 256 * 128
    if colors == 4:
        tree = start + 256 * (c[lead] >> 5)
        c[3], low, span, at = _code_component(low, span, at, chances, tree, c[3], tint, data, writing)
    c[0] = (second + base) & 255
    c[3 - lead] = (third + base) & 255
    return low, span, at


@inner(forceinline=True)
def _code_shape(low, span, at, chances, fields, before, area, v, data, writing):
    """Write or read opacity, order and ratios of the scales.

    Args:
        low: State of the coder, as `span` and `at`; see `code_tree`.
        span: See `low`.
        at: See `low`.
        chances: Probabilities.
        fields: Layout of records.
        before: Order of the last record.
        area: Logarithm of the area of its outline, from which follows how many bits this record is likely to lack.
        v: Fields of this record.
        data: The words.
        writing: Whether to write.
    """
    scale = fields.scale
    place = 256 * bits_to_round(fields.limits.opacity, area) if fields.coarse else np.int64(0)
    v[_OPACITY], low, span, at = code_tree(low, span, at, chances, place, v[_OPACITY], _EIGHT, data, writing)
    place = _ORDERS + 8 * before
    v[_ORDER], low, span, at = code_tree(low, span, at, chances, place, v[_ORDER], _THREE, data, writing)
    light = area + 2 * fields.logs[v[_OPACITY]]
    lacking = bits_to_round(fields.limits.shape, light) if fields.coarse else np.int64(0)
    place = _SHAPE + (2 * lacking << scale)
    v[_MIDDLE], low, span, at = code_tree(low, span, at, chances, place, v[_MIDDLE], scale, data, writing)
    place += np.int64(1) << scale
    v[_SMALLEST], low, span, at = code_tree(low, span, at, chances, place, v[_SMALLEST], scale, data, writing)
    return low, span, at


@inner(forceinline=True)
def _code_turns(low, span, at, chances, start, fields, turn, v, data, writing):
    """Write or read the components of the quaternion, which lack `turn` bits; return the state of the coder."""
    rotation = fields.rotation
    half = (np.int64(1) << (rotation - 1)) - 1
    mask = (np.int64(1) << rotation) - 1
    for k in range(3):
        tree = start + ((TURNS * k + turn) << rotation)
        value = ((v[_ROTATION + k] - half) >> turn) + half
        value, low, span, at = code_tree(low, span, at, chances, tree, value, rotation, data, writing)
        v[_ROTATION + k] = (((value - half) << turn) + half) & mask
    return low, span, at


@inner(forceinline=True)
def _code_low_bits(low, span, at, rows, row, limit, low_bits, data, writing):
    """Write or read the lower bits (3,) of a place in a chunk as far as rounded records have them; return the state.

    Args:
        low: State of the coder, as `span` and `at`; see `code_tree`.
        span: See `low`.
        at: See `low`.
        rows: Rows of chunks.
        row: The chunk.
        limit: log2 of the longest step of a coordinate.
        low_bits: The lower bits.
        data: The words.
        writing: Whether to write.
    """
    for k in range(3):
        below = max(rows.bits[row, k] - DEPTH // 3, 0)
        lacking = min(max(limit - rows.steps[row, k], 0), below)
        value = np.int64(low_bits[k]) >> lacking
        value, low, span, at = code_raw(low, span, at, value, below - lacking, data, writing)
        if not writing:
            low_bits[k] = np.uint16(value << lacking)
    return low, span, at


@inner(forceinline=True)
def _code_top(low, span, at, chances, fields, expected, top, data, writing):
    """Write or read the largest scale, relative to the expected one unless that is -1; return it and the state."""
    scale = fields.scale
    whole = _SHAPE + (2 * _CLASSES << fields.scale)
    other = (1 << STEPS) - 1
    if expected >= 0:
        off = top - expected + BELOW
        off = off if 0 <= off < other else other
        place = whole + (1 << scale)
        off, low, span, at = code_tree(low, span, at, chances, place, off, _STEPS, data, writing)
        if off != other:
            return (expected + off - BELOW) & ((1 << scale) - 1), low, span, at
    return code_tree(low, span, at, chances, whole, top, scale, data, writing)


@kernel
def code(words, terms, low_bits, rows, fields, data, writing):
    """Write the records of a part as words of 32 bits, or read them from there.

    Args:
        words: (G, 2) uint64, the records.
        terms: (G,) uint8, number of terms of each.
        low_bits: (G, 3) uint16, the bits of places below the octree, which are not coded unless records are rounded.
        rows: Rows of the chunks of the part, G Gaussians in all.
        fields: Layout of the records.
        data: (W,) uint32, the words; long enough when writing.
        writing: Whether to write `data` and `low_bits`, or else `words` and `terms`.

    Returns:
        The number of words; -1 if not all words were read.
    """
    scale = fields.scale
    rotations = _SHAPE + ((2 * _CLASSES + 1) << scale) + (1 << STEPS)
    colors = rotations + (3 * TURNS << fields.rotation)
    paths = colors + 256 * (1 + _CONTEXTS) * _CLASSES
    counts = paths + DEPTH * _GRADES * _GRADES
    chances = np.full(counts + 256 * 10, START, np.uint32)
    nodes = np.full((1 << DEPTH, 3), -1, np.int64)
    v = np.zeros(_FIELDS, np.int64)
    i = np.int64(0)
    count = np.int64(0)
    area = np.int64(0)
    turn = np.int64(0)
    tint = np.int64(0)
    most = (1 << fields.counts) - 1
    color = v[_COLOR : _COLOR + 4]
    bits = np.zeros(2, np.uint64)
    low, span, at = begin(data, writing)
    for row in range(len(rows.counts)):
        stride = rows.strides[row]
        least = rows.lows[row]
        strength = np.int64(0)
        wide = rows.bits[row]
        for place in range(rows.counts[row]):
            before = v[_ORDER]
            few = min(count, 9, most)
            if writing:
                _take_record(words, i, fields, wide, v, low_bits)
                count = np.int64(terms[i])
            low, span, at = _code_shape(low, span, at, chances, fields, before, area, v, data, writing)
            strong = weight(v[_MIDDLE], v[_SMALLEST], v[_OPACITY], stride, fields.logs, fields.sums)
            expected = np.int64(-1)
            if place:
                expected = min(max((((strength - strong) >> 1) - least) // stride, 0), (1 << scale) - 1)
            v[_TOP], low, span, at = _code_top(low, span, at, chances, fields, expected, v[_TOP], data, writing)
            size = least + v[_TOP] * stride
            strength = 2 * size + strong
            long = v[_MIDDLE] * stride
            area = 2 * size - long
            if fields.coarse:
                turn = turn_bits(size, long, fields.limits.turn)
                tint = bits_to_round(fields.limits.color, light_of(size, long, v[_OPACITY], fields.logs))
            low, span, at = _code_turns(low, span, at, chances, rotations, fields, turn, v, data, writing)
            low, span, at = _code_color(low, span, at, chances, colors, color, fields.colors, tint, data, writing)
            v[_PATH], low, span, at = _code_path(low, span, at, chances, paths, v[_PATH], nodes, row, data, writing)
            tree = counts + 256 * few
            count, low, span, at = code_tree(low, span, at, chances, tree, count, fields.counts, data, writing)
            if fields.coarse:
                limit = place_limit(size, long, v[_OPACITY], fields.limits.place, fields.logs)
                low, span, at = _code_low_bits(low, span, at, rows, row, limit, low_bits[i], data, writing)
            if not writing:
                _put_record(words, i, fields, wide, v, low_bits, bits)
                terms[i] = np.uint8(count)
            i += 1
    return end(low, at, data, writing)


@kernel
def pack(values, bits, out):
    """Write the low `bits` (M,) bits of values (M,) as one string of bits, lowest first; `out` is uint8, zeros."""
    at = 0
    for i in range(len(values)):
        value = np.int64(values[i])
        left = np.int64(bits[i])
        while left > 0:
            free = 8 - (at & 7)
            out[at >> 3] |= np.uint8((value << (at & 7)) & 255)
            used = min(free, left)
            value = value >> used
            left = left - used
            at = at + used


@kernel
def unpack(data, bits, out):
    """Decode to `out` the values that `pack` wrote; `data` has enough bytes."""
    at = 0
    for i in range(len(out)):
        value = np.int64(0)
        have = np.int64(0)
        whole = np.int64(bits[i])
        while have < whole:
            used = min(8 - (at & 7), whole - have)
            value |= (np.int64(data[at >> 3]) >> (at & 7) & ((1 << used) - 1)) << have
            have = have + used
            at = at + used
        out[i] = value
