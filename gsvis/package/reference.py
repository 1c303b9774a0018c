"""Slow twins of the kernels: one Gaussian at a time in plain Python, as a client would write them."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from gsvis.package.codec import ChunkTable
from gsvis.package.layout import RecordLayout

__all__ = ["decode_one", "encode_one"]

_SQRT_HALF = math.sqrt(0.5)
_LARGEST = float(np.finfo(np.float32).max)


def decode_one(
    record: bytes, table: ChunkTable, row: int, layout: RecordLayout
) -> tuple[list[float], list[float], list[float], float]:
    """Return mean, quaternion, scales and opacity of one record, before rounding to float32."""
    opacity = record[0] / 255.0
    low = int(table.lows[row])
    stride = int(table.strides[row])
    bits = int.from_bytes(record[layout.packed_from :], "little")
    width = sum(layout.bits)
    half = (1 << (layout.rotation - 1)) - 1
    mean = []
    vector = []
    scales = []
    for axis in range(3):
        word = bits >> (axis * width)
        place = word & ((1 << layout.position) - 1)
        turn = (word >> layout.position) & ((1 << layout.rotation) - 1)
        step = float(table.steps[row, axis])
        value = float(table.origins[row, axis]) + place * abs(step)
        if step < 0:
            value = math.copysign(math.expm1(min(abs(value), 700.0)), value)
        mean.append(min(max(value, -_LARGEST), _LARGEST))
        vector.append((turn - half) * (_SQRT_HALF / half))
        size = (word >> (layout.position + layout.rotation)) & ((1 << layout.scale) - 1)
        level = min(max(low + size * stride, -126 * 64), 128 * 64 - 1)
        scales.append(math.ldexp(2.0 ** ((level % 64) / 64.0), level // 64))
    x, y, z = vector
    return mean, [math.sqrt(max(0.0, 1.0 - (x * x + y * y + z * z))), x, y, z], scales, opacity


def encode_one(
    mean: NDArray[np.float32],
    quat: NDArray[np.float32],
    scales: NDArray[np.float32],
    opacity: float,
    color: bytes,
    chunk: tuple[ChunkTable, int],
    layout: RecordLayout,
) -> bytes:
    """Return the record of one Gaussian. `chunk` is a table and a row of it."""
    table, row = chunk
    logs = [min(max(round(math.log2(float(s)) * 64.0), -126 * 64), 128 * 64 - 1) for s in scales]
    logs = [max(level, max(logs) - 11 * 64) for level in logs]
    low = int(table.lows[row])
    stride = int(table.strides[row])
    head = bytes([round(float(opacity) * 255.0), *color])
    w, x, y, z = (float(v) for v in quat)
    forms = [(w, x, y, z), (-x, w, z, -y), (-y, -z, w, x), (-z, y, -x, w)]
    best = max(forms, key=lambda form: abs(form[0]))  # the first of equals
    sign = -1.0 if best[0] < 0 else 1.0
    half = (1 << (layout.rotation - 1)) - 1
    bits = 0
    for axis in range(3):
        step = float(table.steps[row, axis])
        place = 0
        x = float(mean[axis])
        if step != 0:
            along = math.copysign(math.log1p(abs(x)), x) if step < 0 else x
            place = round((along - float(table.origins[row, axis])) / abs(step))
            place = min(place, (1 << int(table.bits[row, axis])) - 1)
        turn = min(max(round(sign * best[1 + axis] / _SQRT_HALF * half) + half, 0), 2 * half)
        size = min((logs[axis] - low + stride // 2) // stride, (1 << layout.scale) - 1)
        word = place | turn << layout.position | size << (layout.position + layout.rotation)
        bits |= word << (axis * sum(layout.bits))
    return head + bits.to_bytes(16 - layout.packed_from, "little")
