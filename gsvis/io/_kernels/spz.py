"""Kernels that unpack SPZ and compressed PLY: one pass per attribute, no temporaries.

They take checked contiguous arrays, run on one thread and release the GIL. They know no file.
"""

from __future__ import annotations

import numpy as np

from gsvis._kernels.compiled import kernel


@kernel
def unpack_quats(bits, table, columns, signs, out):
    """Write (N, 4) unit quaternions from (N,) 32 bits: index of the largest component, then 10 bits for each other.

    `table` has the value of each of the 1,024 codes. Component k of the file goes to column `columns[k]`, times
    `signs[k]`.
    """
    for i in range(len(bits)):
        word = bits[i]
        largest = word >> np.uint32(30)
        shift = np.uint32(20)
        total = 0.0
        for place in range(4):
            if place != largest:
                value = table[(word >> shift) & np.uint32(0x3FF)]
                total += np.float64(value) * np.float64(value)
                out[i, columns[place]] = value * signs[place]
                shift -= np.uint32(10)
        out[i, columns[largest]] = np.float32(np.sqrt(max(0.0, 1.0 - total))) * signs[largest]
        if total > 1.0:  # only in damaged or careless files: normalize the three
            for place in range(4):
                out[i, place] = np.float32(out[i, place] / np.sqrt(total))


@kernel
def unpack_fixed_points(stream, factors, out):
    """Write (N, 3) coordinates of (9 N,) bytes: little-endian signed 24-bit integers, times `factors` of each axis."""
    at = 0
    for i in range(len(out)):
        for axis in range(3):
            value = np.int32(stream[at]) | np.int32(stream[at + 1]) << 8 | np.int32(np.int8(stream[at + 2])) << 16
            out[i, axis] = np.float32(value) * factors[axis]
            at += 3


@kernel
def look_up(stream, table, out):
    """Write the table value of each byte."""
    for i in range(len(stream)):
        out[i] = table[stream[i]]


@kernel
def unpack_higher(rows, factors, out):
    """Write (N, K) coefficients from the first K of (N, J) bytes: their difference from 128, times the factors."""
    for i in range(len(out)):
        for k in range(len(factors)):
            out[i, k] = (np.float32(rows[i, k]) - np.float32(128.0)) * factors[k]


@kernel
def spread_111011(packed, low, high, chunk, out):
    """Write (N, 3) values of 11, 10 and 11 bits, scaled to the ranges (C, 3) of their chunks of `chunk` Gaussians."""
    one = np.float32(1.0)
    for i in range(len(packed)):
        c = i // chunk
        word = packed[i]
        x = np.float32(word >> np.uint32(21)) / np.float32(2047.0)
        y = np.float32((word >> np.uint32(11)) & np.uint32(1023)) / np.float32(1023.0)
        z = np.float32(word & np.uint32(2047)) / np.float32(2047.0)
        out[i, 0] = low[c, 0] * (one - x) + high[c, 0] * x
        out[i, 1] = low[c, 1] * (one - y) + high[c, 1] * y
        out[i, 2] = low[c, 2] * (one - z) + high[c, 2] * z


@kernel
def spread_8888(packed, low, high, chunk, rgb, alpha):
    """Write (N, 3) colors in the ranges (C, 3) of their chunks, and (N,) opacities, of four bytes, red the highest."""
    one = np.float32(1.0)
    most = np.float32(255.0)
    for i in range(len(packed)):
        c = i // chunk
        word = packed[i]
        for channel in range(3):
            unit = np.float32((word >> np.uint32(24 - 8 * channel)) & np.uint32(255)) / most
            rgb[i, channel] = low[c, channel] * (one - unit) + high[c, channel] * unit
        alpha[i] = np.float32(word & np.uint32(255)) / most
