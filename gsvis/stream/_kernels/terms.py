"""Kernels that encode and decode records of terms.

Tables code the upper bits of a field, at most six (seven for the azimuth); lower bits are raw. The leading intensity is
the second of three, or the only one; the others are coded as differences from it. All arithmetic is in integers.
"""

from __future__ import annotations

import numpy as np

from gsvis._kernels.compiled import inner, kernel
from gsvis._kernels.terms import near, upper_bits
from gsvis.stream._kernels.coder import LEAST, RAW, begin, next_bits, next_symbol, push_bits, push_symbol, put_states

MOST_OPERATIONS = 13  # most operations of the coder for a term

# Numbers of the first table of each field; table 0 codes functions.
LEAD = 1  # nine tables: one if the term before belongs to a different Gaussian, else by its leading intensity
DECAY = LEAD + 9  # eight tables: by the leading intensity
POLAR = DECAY + 8  # one table
AZIMUTH = POLAR + 1  # eight tables: by the polar angle
OTHER = AZIMUTH + 8  # 16 tables: by the leading intensity
LAST = OTHER + 16  # 13 tables: by the intensity in `OTHER`
TABLES = LAST + 13  # number of tables

# numbers of upper bits; typed, because numba compiles a function again for a literal
_SIX = np.int64(6)
_SEVEN = np.int64(7)


@inner(forceinline=True)
def _add_field(out, at, symbol, value, bits, most):
    """Append the operations of a field; return the next place.

    The symbol of its upper bits is counted from `symbol`, the first of the table. The lower bits are raw.
    """
    rest = max(bits - most, 0)
    out[at] = symbol + (value >> rest)
    if rest:
        out[at + 1] = RAW | (rest << 16) | (value & ((1 << rest) - 1))
        return at + 2
    return at + 1


@kernel
def operations(records, owners, fields, offsets, out):
    """Write the operations of the coder for each term, in the order of decoding; return their number.

    Args:
        records: (M, B) uint8.
        owners: (M,) int32, never decreasing.
        fields: Bits of the fields.
        offsets: (TABLES + 1,) int64, first symbol of each table.
        out: (MOST_OPERATIONS M,) uint32.
    """
    f = fields.function
    p = fields.polar
    a = fields.azimuth
    d = fields.decay
    n = fields.intensity
    at = 0
    before = np.int64(-1)
    table = 0
    mask = (np.int64(1) << n) - 1
    for i in range(len(records)):
        word = np.uint64(0)
        for k in range(records.shape[1]):
            word |= np.uint64(records[i, k]) << np.uint64(8 * k)
        table = LEAD if owners[i] != before else table
        before = np.int64(owners[i])
        if f:
            at = _add_field(out, at, offsets[0], np.int64(word & np.uint64((1 << f) - 1)), f, _SIX)
        polar = np.int64(word >> np.uint64(f)) & ((1 << p) - 1)
        azimuth = np.int64(word >> np.uint64(f + p)) & ((1 << a) - 1)
        decay = np.int64(word >> np.uint64(f + p + a)) & ((1 << d) - 1)
        first = np.int64(word >> np.uint64(f + p + a + d)) & mask
        lead = np.int64(word >> np.uint64(f + p + a + d + n)) & mask if fields.others else first
        at = _add_field(out, at, offsets[table], lead, n, _SIX)
        upper = upper_bits(lead, n, 6)
        table = LEAD + 1 + (upper >> 3)
        at = _add_field(out, at, offsets[DECAY + (upper >> 3)], decay, d, _SIX)
        at = _add_field(out, at, offsets[POLAR], polar, p, _SIX)
        at = _add_field(out, at, offsets[AZIMUTH + (upper_bits(polar, p, 6) >> 3)], azimuth, a, _SEVEN)
        if fields.others:
            last = np.int64(word >> np.uint64(f + p + a + d + 2 * n)) & mask
            other = (first - lead) & mask
            at = _add_field(out, at, offsets[OTHER + (upper >> 2)], other, n, _SIX)
            at = _add_field(out, at, offsets[LAST + near(other, n)], (last - lead) & mask, n, _SIX)
    return at


@inner(forceinline=True)
def _push_field(symbol, value, bits, most, x, y, at, inverses, spans, out):
    """Encode a field before all fields so far; return the two states and the place of the first word."""
    rest = max(bits - most, 0)
    if rest:
        z, at = push_bits(value & ((1 << rest) - 1), rest, x, at, out)
        x = y
        y = z
    z, at = push_symbol(np.uint64(symbol + (value >> rest)), x, at, inverses, spans, out)
    return y, z, at


@inner(forceinline=True)
def _word(records, row):
    """Return the record of a term as one number."""
    word = np.uint64(0)
    for k in range(records.shape[1]):
        word |= np.uint64(records[row, k]) << np.uint64(8 * k)
    return word


@kernel
def write(records, ids, owners, fields, offsets, inverses, spans, out):
    """Encode terms, in one pass from the last to the first; the result of `coder.write` for their `operations`.

    Args:
        records: (T, B) uint8, of all terms of a scene.
        ids: (M,) uint32, ascending: the terms to write.
        owners: (M,) int32, never decreasing.
        fields: Bits of the fields.
        offsets: (TABLES + 1,) int64, first symbol of each table.
        inverses: See `coder.write`.
        spans: See `coder.write`.
        out: uint16, at least four words longer than the operations.

    Returns:
        The place of the first word.
    """
    f = fields.function
    p = fields.polar
    a = fields.azimuth
    d = fields.decay
    n = fields.intensity
    mask = (np.int64(1) << n) - 1
    places = f + p + a + d
    to_lead = np.uint64(places + n if fields.others else places)
    # states of the next operation, and of the one after it
    x = np.uint64(LEAST)
    y = np.uint64(LEAST)
    at = len(out)
    word = _word(records, ids[len(ids) - 1])
    for i in range(len(ids) - 1, -1, -1):
        lead = np.int64(word >> to_lead) & mask
        upper = upper_bits(lead, n, 6)
        if fields.others:
            first = np.int64(word >> np.uint64(places)) & mask
            last = np.int64(word >> np.uint64(places + 2 * n)) & mask
            other = (first - lead) & mask
            symbol = offsets[LAST + near(other, n)]
            x, y, at = _push_field(symbol, (last - lead) & mask, n, _SIX, x, y, at, inverses, spans, out)
            x, y, at = _push_field(offsets[OTHER + (upper >> 2)], other, n, _SIX, x, y, at, inverses, spans, out)
        polar = np.int64(word >> np.uint64(f)) & ((1 << p) - 1)
        azimuth = np.int64(word >> np.uint64(f + p)) & ((1 << a) - 1)
        decay = np.int64(word >> np.uint64(f + p + a)) & ((1 << d) - 1)
        symbol = offsets[AZIMUTH + (upper_bits(polar, p, 6) >> 3)]
        x, y, at = _push_field(symbol, azimuth, a, _SEVEN, x, y, at, inverses, spans, out)
        x, y, at = _push_field(offsets[POLAR], polar, p, _SIX, x, y, at, inverses, spans, out)
        x, y, at = _push_field(offsets[DECAY + (upper >> 3)], decay, d, _SIX, x, y, at, inverses, spans, out)
        function = np.int64(word & np.uint64((1 << f) - 1))
        table = LEAD
        if i > 0:
            word = _word(records, ids[i - 1])
            if owners[i] == owners[i - 1]:
                table = LEAD + 1 + (upper_bits(np.int64(word >> to_lead) & mask, n, 6) >> 3)
        x, y, at = _push_field(offsets[table], lead, n, _SIX, x, y, at, inverses, spans, out)
        if f:
            x, y, at = _push_field(offsets[0], function, f, _SIX, x, y, at, inverses, spans, out)
    return put_states(y, x, at, out)


@inner(forceinline=True)
def _next_field(words, x, y, at, table, bits, most, slots, tables, offsets, spans):
    """Decode a field; return its value, the two states, and the place of the next word."""
    rest = max(bits - most, 0)
    value, x, y, at = next_symbol(words, x, y, at, table, slots, tables, offsets, spans)
    low, x, y, at = next_bits(words, x, y, at, rest)
    return (value << rest) | low, x, y, at


@kernel
def read(words, owners, fields, code, out):
    """Decode terms; return whether the words are valid and have nothing else.

    Args:
        words: (W,) uint16.
        owners: (M,) int64, never decreasing.
        fields: Bits of the fields.
        code: Tables of the scene.
        out: (M, B) uint8.
    """
    f = fields.function
    p = fields.polar
    a = fields.azimuth
    d = fields.decay
    n = fields.intensity
    mask = (np.int64(1) << n) - 1
    if len(words) < 4:
        return False
    slots = code.slots
    tables = code.rows
    offsets = code.offsets
    spans = code.spans
    (x, y), at = begin(words), 4
    before = np.int64(-1)
    table = 0
    for i in range(len(out)):
        if at > len(words):
            return False
        table = LEAD if owners[i] != before else table
        before = np.int64(owners[i])
        function = np.int64(0)
        if f:
            function, x, y, at = _next_field(words, x, y, at, np.int64(0), f, _SIX, slots, tables, offsets, spans)
        lead, x, y, at = _next_field(words, x, y, at, table, n, _SIX, slots, tables, offsets, spans)
        upper = upper_bits(lead, n, 6)
        table = LEAD + 1 + (upper >> 3)
        decay, x, y, at = _next_field(words, x, y, at, DECAY + (upper >> 3), d, _SIX, slots, tables, offsets, spans)
        polar, x, y, at = _next_field(words, x, y, at, np.int64(POLAR), p, _SIX, slots, tables, offsets, spans)
        azimuth, x, y, at = _next_field(
            words, x, y, at, AZIMUTH + (upper_bits(polar, p, 6) >> 3), a, _SEVEN, slots, tables, offsets, spans
        )
        word = np.uint64(function) | np.uint64(polar) << np.uint64(f) | np.uint64(azimuth) << np.uint64(f + p)
        word |= np.uint64(decay) << np.uint64(f + p + a)
        if fields.others:
            rest, x, y, at = _next_field(words, x, y, at, OTHER + (upper >> 2), n, _SIX, slots, tables, offsets, spans)
            last, x, y, at = _next_field(words, x, y, at, LAST + near(rest, n), n, _SIX, slots, tables, offsets, spans)
            word |= np.uint64((rest + lead) & mask) << np.uint64(f + p + a + d)
            word |= np.uint64(lead) << np.uint64(f + p + a + d + n)
            word |= np.uint64((last + lead) & mask) << np.uint64(f + p + a + d + 2 * n)
        else:
            word |= np.uint64(lead) << np.uint64(f + p + a + d)
        for k in range(out.shape[1]):
            out[i, k] = np.uint8((word >> np.uint64(8 * k)) & np.uint64(255))
    return at == len(words) and x == np.uint64(LEAST) and y == np.uint64(LEAST)
