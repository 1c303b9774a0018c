"""Kernel of coded terms: one function writes and reads the terms of a part, field by field.

The leading intensity is the second of three, or the only one; the others are coded as differences from it. Fields of
more than eight bits are coded in two parts. Terms of rounded records lack bits, and their fields have more contexts: by
the bits that a term is likely to lack. Any terms can be coded with them. All arithmetic is in integers.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gsvis._kernels.compiled import inner, kernel
from gsvis._kernels.terms import near, upper_bits
from gsvis.package._kernels.adaptive import START, begin, code_tree, end

_INTENSITIES = 4  # classes of bits that intensities lack
_DECAYS = 4  # the same of decays
_CENTERS = 10  # the same of centers, in half bits

# the first context of each field; context 0 is that of the function
_LEAD = 1
_DECAY = _LEAD + 9 * _INTENSITIES
_POLAR = _DECAY + 8 * _DECAYS
_AZIMUTH = _POLAR + 9 + 2 * _CENTERS
_OTHER = _AZIMUTH + 8 * _CENTERS
_LAST = _OTHER + 16 * _INTENSITIES
_CONTEXTS = _LAST + 13 * _INTENSITIES


class TermRules(NamedTuple):
    """What tells how many bits the terms of a scene lack.

    Attributes:
        coarse: Whether records are rounded; if not, all else is ignored.
        center: Bits that centers lack where light and intensity are 1, in 1/64; one less for each octave of intensity,
            a quarter less for each of light.
        decay: The same of decays.
        intensity: Bits that intensities lack where the light is 1, in 1/64; a quarter less for each octave of light.
        sizes: (2^bits,) int64, 64 log2 of the size of each intensity.
    """

    coarse: bool
    center: int
    decay: int
    intensity: int
    sizes: NDArray[np.int64]


@inner(forceinline=True)
def _class_of(limit, weight, step, count):
    """Return the class, below `count`, of what a term lacks: the limit less its weight in steps of 2^step."""
    return min(max((limit - weight) >> step, 0), count - 1)


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
def code(records, firsts, lights, rules, fields, data, writing):
    """Write the terms of a part as words of 32 bits, or read them from there.

    Args:
        records: (M, B) uint8, the terms.
        firsts: (M,) bool, whether a term is the first of its Gaussian.
        lights: (M,) int64, the light of its Gaussian, see `light_of`; (0,) unless records are rounded.
        rules: What tells how many bits terms lack.
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
    light = np.int64(0)
    of_light = np.int64(0)  # classes
    of_decay = np.int64(0)
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
        is_first = np.int64(firsts[i])
        of_last = np.int64(0) if is_first else 1 + of_before
        function, low, span, at = _code_field(low, span, at, chances, np.int64(0), function, f, data, writing)
        if rules.coarse:
            light = lights[i] >> 2
            of_light = _class_of(rules.intensity, light, 6, _INTENSITIES)
        context = _LEAD + 9 * of_light + of_last
        lead, low, span, at = _code_field(low, span, at, chances, context, lead, n, data, writing)
        of_before = upper_bits(lead, n, 3)
        polars = _POLAR + of_last
        azimuths = np.int64(_AZIMUTH)
        if rules.coarse:
            weight = light + rules.sizes[lead]
            of_decay = _class_of(rules.decay, weight, 6, _DECAYS)
            of_center = _class_of(rules.center, weight, 5, _CENTERS)
            polars = _POLAR + 9 + 2 * of_center + is_first
            azimuths = _AZIMUTH + 8 * of_center
        context = _DECAY + 8 * of_decay + of_before
        decay, low, span, at = _code_field(low, span, at, chances, context, decay, d, data, writing)
        polar, low, span, at = _code_field(low, span, at, chances, polars, polar, p, data, writing)
        context = azimuths + upper_bits(polar, p, 3)
        azimuth, low, span, at = _code_field(low, span, at, chances, context, azimuth, a, data, writing)
        if fields.others:
            other = (first - lead) & mask
            context = _OTHER + 16 * of_light + upper_bits(lead, n, 4)
            other, low, span, at = _code_field(low, span, at, chances, context, other, n, data, writing)
            first = (other + lead) & mask
            context = _LAST + 13 * of_light + near(other, n)
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
