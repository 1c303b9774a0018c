"""Kernels of the coder: symbols of tables and raw bits become words of 16 bits, and back.

rANS with tables of 12 bits and two states of 32 bits. The encoder runs backwards, so that the decoder runs forwards.
All arithmetic is of integers. Arrays are checked and contiguous.

References:
    Duda, "Asymmetric numeral systems: entropy coding combining speed of Huffman coding with compression rate of
    arithmetic coding", arXiv 1311.2540, section 3 (range variant).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gsvis._kernels.compiled import inner, kernel

BITS = 12
TOTAL = 1 << BITS
LEAST = 1 << 16  # the state is between this and 2^32
RAW = 1 << 31  # marks an operation that writes raw bits
INVERSE = 44  # fraction bits of inverse sizes: enough for exact division, and products stay below 2^64


class Decoder(NamedTuple):
    """Tables for decoding. Symbols are numbered over all tables.

    Attributes:
        slots: (R, TOTAL) uint16, the symbol at each slot, for each table that has symbols.
        rows: (K,) int32, row of each table in `slots`; -1 for a table without symbols.
        offsets: (K + 1,) int64, first symbol of each table.
        spans: (S,) uint32, first slot of each symbol, and from bit 16 on its number of slots.
    """

    slots: NDArray[np.uint16]
    rows: NDArray[np.int32]
    offsets: NDArray[np.int64]
    spans: NDArray[np.uint32]


@inner(forceinline=True)
def begin(words):
    """Return the two states that the first four words hold."""
    high = np.uint64(16)
    return np.uint64(words[0]) | (np.uint64(words[1]) << high), np.uint64(words[2]) | (np.uint64(words[3]) << high)


@inner(forceinline=True)
def next_symbol(words, state, other, at, table, slots, rows, offsets, spans):
    """Return the next symbol of a table, the two states in their next order, and the place of the next word.

    The place is beyond the end if words are missing or the table has no symbols. For tables see `Decoder`.
    """
    row = rows[table]
    slot = state & np.uint64(TOTAL - 1)
    found = np.int64(slots[max(row, 0), slot])
    span = np.uint64(spans[found])
    state = (span >> np.uint64(16)) * (state >> np.uint64(BITS)) + slot - (span & np.uint64(0xFFFF))
    if state < np.uint64(LEAST):
        state = (state << np.uint64(16)) | (np.uint64(words[at]) if at < len(words) else np.uint64(0))
        at += 1
    if row < 0:
        return np.int64(0), other, state, np.int64(len(words) + 1)
    return found - offsets[table], other, state, at


@inner(forceinline=True)
def next_bits(words, state, other, at, count):
    """Return 0 to 16 raw bits, then states and place as `next_symbol`; 0 bits read nothing."""
    if count == 0:
        return np.int64(0), state, other, at
    found = np.int64(state & ((np.uint64(1) << np.uint64(count)) - np.uint64(1)))
    state >>= np.uint64(count)
    if state < np.uint64(LEAST):
        state = (state << np.uint64(16)) | (np.uint64(words[at]) if at < len(words) else np.uint64(0))
        at += 1
    return found, other, state, at


@inner(forceinline=True)
def push_symbol(symbol, state, at, inverses, spans, out):
    """Write a symbol before all symbols so far; return the new state, and the place of the first word."""
    span = np.uint64(spans[symbol])
    size = span >> np.uint64(16)
    out[at - 1] = np.uint16(state & np.uint64(0xFFFF))
    full = state >> np.uint64(32 - BITS) >= size
    state = state >> np.uint64(16) if full else state
    quotient = (state * inverses[symbol]) >> np.uint64(INVERSE)
    return quotient * (np.uint64(TOTAL) - size) + (state + (span & np.uint64(0xFFFF))), at - full


@inner(forceinline=True)
def push_bits(value, count, state, at, out):
    """Write 1 to 16 raw bits before all symbols so far; return as `push_symbol`."""
    bits = np.uint64(count)
    out[at - 1] = np.uint16(state & np.uint64(0xFFFF))
    full = (state >> (np.uint64(32) - bits)) != np.uint64(0)
    state = state >> np.uint64(16) if full else state
    return (state << bits) | np.uint64(value), at - full


@inner(forceinline=True)
def _push_operation(operation, state, at, inverses, spans, out):
    """Write the symbol or the raw bits of an operation; return as `push_symbol`."""
    if operation & np.uint32(RAW):
        return push_bits(operation & np.uint32(0xFFFF), (operation >> np.uint32(16)) & np.uint32(31), state, at, out)
    return push_symbol(operation, state, at, inverses, spans, out)


@inner(forceinline=True)
def put_states(first, second, at, out):
    """Write the decoder's initial states before all words; return the place of the first word."""
    for state in (second, first):
        out[at - 1] = np.uint16(state >> np.uint64(16))
        out[at - 2] = np.uint16(state & np.uint64(0xFFFF))
        at -= 2
    return at


@kernel
def write(operations, inverses, spans, out):
    """Write operations as words of 16 bits, backward from the end of `out`; the decoder's initial states come first.

    Operations use the two states in turn, so that a processor can work on two at once.

    Args:
        operations: (M,) uint32: the number of a symbol; or RAW, the number of raw bits from bit 16 on, and the bits.
        inverses: (S,) uint64, 2^INVERSE over the size of each symbol, rounded up.
        spans: (S,) uint32, see `Decoder`; symbols that occur have at least one slot.
        out: (M + 4,) uint16 or longer.

    Returns:
        The place of the first word.
    """
    first = np.uint64(LEAST)
    second = np.uint64(LEAST)
    at = len(out)
    i = len(operations)
    if i & 1:
        i -= 1
        first, at = _push_operation(operations[i], first, at, inverses, spans, out)
    while i > 0:
        second, at = _push_operation(operations[i - 1], second, at, inverses, spans, out)
        first, at = _push_operation(operations[i - 2], first, at, inverses, spans, out)
        i -= 2
    return put_states(first, second, at, out)


@kernel
def count(operations, counts):
    """Add the symbols of operations to their counts (S,)."""
    for i in range(len(operations)):
        if not operations[i] & np.uint32(RAW):
            counts[operations[i]] += 1


@kernel
def fill(weights, offsets, spans):
    """Compute the slots of each symbol from its weight.

    A table has TOTAL slots. Each symbol with a weight gets one slot, and a share of the rest by its weight.

    Args:
        weights: (S,) int64, 0 for symbols that do not occur.
        offsets: (K + 1,) int64, first symbol of each table.
        spans: (S,) uint32, receives the slots; see `Decoder`.
    """
    for k in range(len(offsets) - 1):
        some = 0
        total = np.int64(0)
        for i in range(offsets[k], offsets[k + 1]):
            some += weights[i] > 0
            total += weights[i]
        before = np.int64(0)
        seen = 0
        start = np.int64(0)
        for i in range(offsets[k], offsets[k + 1]):
            before += weights[i]
            seen += weights[i] > 0
            end = before * (TOTAL - some) // total + seen if total else np.int64(0)
            spans[i] = start | (end - start) << 16
            start = end


@kernel
def fill_slots(offsets, spans, rows, slots):
    """Fill `Decoder.slots` from the other arrays of a `Decoder`."""
    for k in range(len(rows)):
        if rows[k] >= 0:
            for i in range(offsets[k], offsets[k + 1]):
                start = np.int64(spans[i] & np.uint32(0xFFFF))
                slots[rows[k], start : start + np.int64(spans[i] >> np.uint32(16))] = i
