"""Kernel that rounds records: bits that a record lacks become zeros, by the rules of `gsvis._kernels.rounding`."""

from __future__ import annotations

import numpy as np

from gsvis._kernels.compiled import inner, kernel
from gsvis._kernels.records import put, take
from gsvis._kernels.rounding import bits_to_round, light_of, place_limit, turn_bits

# typed, because numba compiles a function again for a literal
_NONE = np.int64(0)
_BYTE = np.int64(255)


@kernel
def round_records(words, rows, chunks, bits, colors, limits, logs, stated, out):
    """Round records.

    Args:
        words: (N, 2) uint64, records.
        rows: (N,) int32, row of the chunk of each.
        chunks: Rows of chunks.
        bits: Bits of a coordinate, of a component of a quaternion, and of a log-scale.
        colors: Bytes of the base color.
        limits: How records are rounded.
        logs: First table of `logarithms`.
        stated: Whether the bits that a color lacks follow from the rounded record, so that a reader can tell.
        out: (N, 2) uint64, receives the records.
    """
    position, rotation, scale = bits
    width = position + rotation + scale
    head = 8 * (1 + colors)
    s = np.empty(3, np.int64)
    record = np.empty(2, np.uint64)
    half = (1 << (rotation - 1)) - 1
    for i in range(len(words)):
        low = words[i, 0]
        high = words[i, 1]
        row = rows[i]
        stride = chunks.strides[row]
        opacity = np.int64(low & np.uint64(255))
        for k in range(3):
            s[k] = take(low, high, head + k * width + position + rotation, scale)
        top = max(s[0], s[1], s[2])
        size = chunks.lows[row] + top * stride
        long = _middle(s, top) * stride
        light = light_of(size, long, opacity, logs)
        opacity = _round(opacity, bits_to_round(limits.opacity, 2 * size - long), _NONE, _BYTE)
        shape = bits_to_round(limits.shape, light)
        for k in range(3):  # relative to the largest scale, which is not rounded
            s[k] = top - _round(top - s[k], shape, _NONE, top)
        long = _middle(s, top) * stride
        record[0], record[1] = np.uint64(opacity), np.uint64(0)
        if stated:
            light = light_of(size, long, opacity, logs)
        tint = bits_to_round(limits.color, light)
        turn = turn_bits(size, long, limits.turn)
        limit = place_limit(size, long, opacity, limits.place, logs)
        for k in range(colors):
            color = np.int64((low >> np.uint64(8 * (1 + k))) & np.uint64(255))
            put(record, 8 * (1 + k), _round(color, tint, _NONE, _BYTE))
        for k in range(3):
            at = head + k * width
            wide = chunks.bits[row, k]
            lacking = min(max(limit - chunks.steps[row, k], 0), wide)
            put(record, at, _round(take(low, high, at, position), lacking, _NONE, (np.int64(1) << wide) - 1))
            put(record, at + position, _round(take(low, high, at + position, rotation), turn, half, 2 * half + 1))
            put(record, at + position + rotation, s[k])
        out[i, 0], out[i, 1] = record[0], record[1]


@kernel
def lights(words, rows, chunks, bits, colors, logs, out):
    """Write the light (N,) int64 of records, see `light_of`; arguments as for `round_records`."""
    position, rotation, scale = bits
    width = position + rotation + scale
    head = 8 * (1 + colors)
    s = np.empty(3, np.int64)
    for i in range(len(words)):
        stride = chunks.strides[rows[i]]
        for k in range(3):
            s[k] = take(words[i, 0], words[i, 1], head + k * width + position + rotation, scale)
        top = max(s[0], s[1], s[2])
        size = chunks.lows[rows[i]] + top * stride
        opacity = np.int64(words[i, 0] & np.uint64(255))
        out[i] = light_of(size, _middle(s, top) * stride, opacity, logs)


@inner(forceinline=True)
def _middle(scales, top):
    """Return the largest of three scales (`top`) minus the middle one."""
    return 2 * top - scales[0] - scales[1] - scales[2] + min(scales[0], scales[1], scales[2])


@inner(forceinline=True)
def _round(value, bits, center, most):
    """Round a value to a multiple of 2^bits from `center`, ties to even, within 0 and `most`."""
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
