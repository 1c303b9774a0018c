"""Kernels of the package: chunks of Gaussians, records of 16 bytes.

Arrays are checked and contiguous. Decoding uses only integers, exact float64 products and correctly rounded operations,
so any client that follows `reference.py` gets the same bits. In a logarithmic chunk, coordinates may differ by the
rounding of one exponential.
"""

from __future__ import annotations

import numpy as np

from gsvis._kernels.compiled import kernel

__all__ = ["chunk_starts", "decode", "encode", "put_places", "sort_chunks"]

SQRT_HALF = 0.7071067811865476
# range of log-scales in 1/64 octaves: normal numbers of float32
LEAST_LOG = -126 * 64
MOST_LOG = 128 * 64 - 1
THINNEST = 11 * 64  # a scale that is smaller than the largest by more than this is raised, which nobody sees
LARGEST = np.float64(np.finfo(np.float32).max)


@kernel
def log_scales(scales, out):
    """Write log-scales (N, 3) int32 in 1/64 octaves, at most `THINNEST` below the largest; return the largest (N,)."""
    largest = np.empty(len(scales), np.int32)
    for i in range(len(scales)):
        most = LEAST_LOG
        for k in range(3):
            level = int(np.rint(np.log2(np.float64(scales[i, k])) * 64.0))
            out[i, k] = min(max(level, LEAST_LOG), MOST_LOG)
            most = max(most, out[i, k])
        for k in range(3):
            out[i, k] = max(out[i, k], most - THINNEST)
        largest[i] = most
    return largest


@kernel
def chunk_starts(means, largest, steps, places, most, spread, starts):
    """Divide consecutive Gaussians into chunks whose records are fine enough for each of them.

    Args:
        means: (N, 3).
        largest: (N,) largest log-scale of each Gaussian.
        steps: (N,) coarsest step of a coordinate that each Gaussian may have, > 0.
        places: Number of steps along the side of a box.
        most: Most Gaussians in a chunk.
        spread: Largest difference of `largest` in a chunk.
        starts: (N,) int64, receives the first Gaussian of each chunk.

    Returns:
        The number of chunks.
    """
    low = np.empty(3)
    high = np.empty(3)
    count = 0
    finest = 0.0
    least = 0
    top = 0
    for i in range(len(means)):
        fits = count > 0 and i - starts[count - 1] < most
        if fits:
            finer = min(finest, steps[i])
            for k in range(3):
                side = max(high[k], means[i, k]) - min(low[k], means[i, k])
                fits = fits and side <= finer * places
            fits = fits and max(top, largest[i]) - min(least, largest[i]) <= spread
        if not fits:
            starts[count] = i
            count += 1
            finest = steps[i]
            least = largest[i]
            top = largest[i]
            for k in range(3):
                low[k] = high[k] = means[i, k]
            continue
        finest = min(finest, steps[i])
        least = min(least, largest[i])
        top = max(top, largest[i])
        for k in range(3):
            low[k] = min(low[k], means[i, k])
            high[k] = max(high[k], means[i, k])
    return count


@kernel
def sort_chunks(starts, values, order):
    """Write the order (N,) int64 in which the largest value of each chunk comes first; equal ones stay in order.

    Args:
        starts: (C,) first Gaussian of each chunk.
        values: (N,) finite.
        order: (N,) int64, receives the order.
    """
    for c in range(len(starts)):
        low = starts[c]
        high = starts[c + 1] if c + 1 < len(starts) else len(values)
        order[low:high] = low + np.argsort(-values[low:high], kind="mergesort")


@kernel
def put_places(words, ids, places, bits, first):
    """Replace the places in records; no place crosses the middle of a record.

    Args:
        words: (N, 2) uint64, the records; changed.
        ids: (M,) the records to change.
        places: (M, 3) int32, the new places.
        bits: Bits of a coordinate, of a component of a quaternion, and of a log-scale.
        first: Byte at which the bit string begins.
    """
    position, rotation, scale = bits
    for i in range(len(ids)):
        for k in range(3):
            bit = 8 * first + k * (position + rotation + scale)
            mask = np.uint64((1 << position) - 1) << np.uint64(bit & 63)
            word = words[ids[i], bit >> 6] & ~mask
            words[ids[i], bit >> 6] = word | np.uint64(places[i, k]) << np.uint64(bit & 63)


@kernel
def encode(chunk, places, lows, strides, quats, levels, opacities, colors, bits, out):
    """Encode Gaussians as records.

    Args:
        chunk: (N,) row of the chunk of each Gaussian.
        places: (N, 3) int32, places in the box of the chunk.
        lows: (C,) int16, lowest log-scale in 1/64 octave.
        strides: (C,) uint8, steps of log-scales.
        quats: (N, 4) float32, unit, wxyz.
        levels: (N, 3) int32 log-scales.
        opacities: (N,) float32.
        colors: (N, 3 or 4) uint8 base color, and maybe its scale.
        bits: Bits of a coordinate, of a component of a quaternion, and of a log-scale.
        out: (N, 16) uint8 zeros, receives the records.
    """
    position, rotation, scale = bits
    half = (1 << (rotation - 1)) - 1
    sizes = (1 << scale) - 1
    width = position + rotation + scale
    first = 1 + colors.shape[1]
    forms = np.empty((4, 4))
    for i in range(len(chunk)):
        c = chunk[i]
        out[i, 0] = np.uint8(np.rint(np.float64(opacities[i]) * 255.0))
        for k in range(colors.shape[1]):
            out[i, 1 + k] = colors[i, k]
        w = np.float64(quats[i, 0])
        x = np.float64(quats[i, 1])
        y = np.float64(quats[i, 2])
        z = np.float64(quats[i, 3])
        # Half a turn about one of its axes does not change an ellipsoid. Use the form with the largest |w| of the four.
        forms[0, 0] = w
        forms[0, 1] = x
        forms[0, 2] = y
        forms[0, 3] = z
        forms[1, 0] = -x
        forms[1, 1] = w
        forms[1, 2] = z
        forms[1, 3] = -y
        forms[2, 0] = -y
        forms[2, 1] = -z
        forms[2, 2] = w
        forms[2, 3] = x
        forms[3, 0] = -z
        forms[3, 1] = y
        forms[3, 2] = -x
        forms[3, 3] = w
        best = 0
        for f in range(1, 4):
            if abs(forms[f, 0]) > abs(forms[best, 0]):
                best = f
        sign = -1.0 if forms[best, 0] < 0.0 else 1.0
        for k in range(3):
            turn = np.int64(np.rint(sign * forms[best, 1 + k] / SQRT_HALF * half)) + half
            size = np.int64((levels[i, k] - int(lows[c]) + int(strides[c]) // 2) // int(strides[c]))
            word = (
                np.int64(places[i, k])
                | (min(max(turn, 0), 2 * half) << position)
                | (min(size, sizes) << (position + rotation))
            )
            bit = k * width
            word <<= bit & 7
            byte = first + (bit >> 3)
            while word:
                out[i, byte] |= np.uint8(word & 255)
                word >>= 8
                byte += 1


@kernel
def decode(chunk, origins, steps, lows, strides, records, bits, first, roots, means, quats, scales, opacities):
    """Decode records into means (M, 3), quats (M, 4), scales (M, 3) and opacities (M,), all float32.

    Args:
        chunk: (M,) row of the chunk of each Gaussian.
        origins: (C, 3) float32, lowest corners.
        steps: (C, 3) float32, steps of the coordinates; those of symmetric logarithms are below 0.
        lows: (C,) int16, lowest log-scale in 1/64 octave.
        strides: (C,) uint8, steps of log-scales.
        records: (M, 16) uint8.
        bits: Bits of a coordinate, of a component of a quaternion, and of a log-scale.
        first: Byte at which the string of bits begins.
        roots: (64,) float64, 2^(k / 64).
        means: (M, 3), receives the centers.
        quats: (M, 4), receives unit quaternions, wxyz.
        scales: (M, 3), receives standard deviations.
        opacities: (M,), receives opacities.
    """
    position, rotation, scale = bits
    half = (1 << (rotation - 1)) - 1
    width = position + rotation + scale
    unit = SQRT_HALF / half
    v = np.empty(3)
    for i in range(len(chunk)):
        c = chunk[i]
        opacities[i] = np.float32(np.float64(records[i, 0]) / 255.0)
        for k in range(3):
            bit = k * width
            byte = first + (bit >> 3)
            shift = bit & 7
            word = np.int64(0)
            for b in range(5):
                if byte + b < 16:
                    word |= np.int64(records[i, byte + b]) << (8 * b)
            word >>= shift
            place = word & ((1 << position) - 1)
            turn = (word >> position) & ((1 << rotation) - 1)
            size = (word >> (position + rotation)) & ((1 << scale) - 1)
            level = min(max(int(lows[c]) + size * int(strides[c]), LEAST_LOG), MOST_LOG)
            scales[i, k] = np.float32(np.ldexp(roots[level & 63], level >> 6))
            step = np.float64(steps[c, k])
            value = np.float64(origins[c, k]) + np.float64(place) * abs(step)
            if step < 0.0:
                value = np.copysign(np.expm1(abs(value)), value)
            means[i, k] = np.float32(min(max(value, -LARGEST), LARGEST))
            v[k] = np.float64(turn - half) * unit
        rest = 1.0 - (v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
        quats[i, 0] = np.float32(np.sqrt(max(rest, 0.0)))
        for k in range(3):
            quats[i, 1 + k] = np.float32(v[k])
