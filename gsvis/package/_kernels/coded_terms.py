"""Kernel of coded terms: one function writes and reads the terms of a part, field by field.

The leading intensity is the second of three, or the only one; the others are coded as differences from it. Fields of
more than eight bits are coded in two parts. All arithmetic is in integers.
"""

from __future__ import annotations

import numpy as np

from gsvis._kernels.compiled import inner, kernel
from gsvis._kernels.terms import near, upper_bits
from gsvis.package._kernels.adaptive import START, begin, code_tree, end

_CONTEXTS = 1 + 9 + 8 + 9 + 8 + 16 + 13  # contexts of all fields


@inner(forceinline=True)
def _code_field(low, span, at, chances, context, value, bits, data, writing):
    """Write or read a field of 0 to 16 bits in a context; return it and the state."""
    rest = max(bits - 8, 0)
    start = context * 512
    upper, low, span, at = code_tree(low, span, at, chances, start, value >> rest, bits - rest, data, writing)
    if rest == 0:
        return upper, low, span, at
    lower, low, span, at = code_tree(
        low, span, at, chances, start + 256, value & ((1 << rest) - 1), rest, data, writing
    )
    return upper << rest | lower, low, span, at


@kernel
def code(records, firsts, fields, data, writing):
    """Write the terms of a part as words of 32 bits, or read them from there.

    Args:
        records: (M, B) uint8, the terms.
        firsts: (M,) bool, whether a term is the first of its Gaussian.
        fields: Bits of the fields.
        data: (W,) uint32, the words; long enough when writing.
        writing: Whether to write `data`, or else `records`.

    Returns:
        The number of words; -1 if not all words were read.
    """
    f = fields.function
    p = fields.polar
    a = fields.azimuth
    d = fields.decay
    n = fields.intensity
    mask = (np.int64(1) << n) - 1
    width = records.shape[1]
    # the first context of each field; context 0 is that of the function
    leads = 1
    decays = 10
    polars = 18
    azimuths = 27
    others = 35
    lasts = 51
    chances = np.full(512 * _CONTEXTS, START, np.uint32)
    low, span, at = begin(data, writing)
    function = np.int64(0)
    polar = np.int64(0)
    azimuth = np.int64(0)
    decay = np.int64(0)
    first = np.int64(0)
    lead = np.int64(0)
    last = np.int64(0)
    of_before = np.int64(0)
    for i in range(len(records)):
        if writing:
            word = np.uint64(0)
            for k in range(width):
                word |= np.uint64(records[i, k]) << np.uint64(8 * k)
            function = np.int64(word & np.uint64((1 << f) - 1))
            polar = np.int64(word >> np.uint64(f)) & ((1 << p) - 1)
            azimuth = np.int64(word >> np.uint64(f + p)) & ((1 << a) - 1)
            decay = np.int64(word >> np.uint64(f + p + a)) & ((1 << d) - 1)
            first = np.int64(word >> np.uint64(f + p + a + d)) & mask
            lead = np.int64(word >> np.uint64(f + p + a + d + n)) & mask if fields.others else first
            last = np.int64(word >> np.uint64(f + p + a + d + 2 * n)) & mask if fields.others else np.int64(0)
        context = leads if firsts[i] else leads + 1 + of_before
        of_polar = polars if firsts[i] else polars + 1 + of_before
        function, low, span, at = _code_field(low, span, at, chances, np.int64(0), function, f, data, writing)
        lead, low, span, at = _code_field(low, span, at, chances, context, lead, n, data, writing)
        of_before = upper_bits(lead, n, 3)
        decay, low, span, at = _code_field(low, span, at, chances, decays + of_before, decay, d, data, writing)
        polar, low, span, at = _code_field(low, span, at, chances, of_polar, polar, p, data, writing)
        context = azimuths + upper_bits(polar, p, 3)
        azimuth, low, span, at = _code_field(low, span, at, chances, context, azimuth, a, data, writing)
        if fields.others:
            other = (first - lead) & mask
            context = others + upper_bits(lead, n, 4)
            other, low, span, at = _code_field(low, span, at, chances, context, other, n, data, writing)
            first = (other + lead) & mask
            context = lasts + near(other, n)
            other, low, span, at = _code_field(low, span, at, chances, context, (last - lead) & mask, n, data, writing)
            last = (other + lead) & mask
        if not writing:
            word = np.uint64(function) | np.uint64(polar) << np.uint64(f) | np.uint64(azimuth) << np.uint64(f + p)
            word |= np.uint64(decay) << np.uint64(f + p + a)
            if fields.others:
                word |= np.uint64(first) << np.uint64(f + p + a + d)
                word |= np.uint64(lead) << np.uint64(f + p + a + d + n)
                word |= np.uint64(last) << np.uint64(f + p + a + d + 2 * n)
            else:
                word |= np.uint64(lead) << np.uint64(f + p + a + d)
            for k in range(width):
                records[i, k] = np.uint8((word >> np.uint64(8 * k)) & np.uint64(255))
    return end(low, at, data, writing)
