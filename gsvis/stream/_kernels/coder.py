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
INVERSE = 44  # bits of the inverse of a size, rounded up: exact for every state that is divided, and below 2^64


class Decoder(NamedTuple):
    """Tables as a decoder needs them.

    Attributes:
        slots: (R, TOTAL) uint16, the symbol at each slot of each table that has symbols; symbols are counted over all
            tables.
        rows: (K,) int32, row of each table in `slots`; -1 for those without symbols.
        offsets: (K + 1,) int64, first symbol of each table.
        spans: (S,) uint32, first slot of each symbol, and from bit 16 on how many it has.
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
    """Return a symbol of a table, the state of the next operation and the other one, and the place of the next word.

    The place is beyond the end if words or symbols are missing. For tables see `Decoder`.
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
    """Return 0 to 16 raw bits, then the same as `next_symbol`; no bits are no operation."""
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
    """Write a symbol before all operations so far; return its state, and the place of the first word."""
    span = np.uint64(spans[symbol])
    size = span >> np.uint64(16)
    out[at - 1] = np.uint16(state & np.uint64(0xFFFF))
    full = state >> np.uint64(32 - BITS) >= size
    state = state >> np.uint64(16) if full else state
    quotient = (state * inverses[symbol]) >> np.uint64(INVERSE)
    return quotient * (np.uint64(TOTAL) - size) + (state + (span & np.uint64(0xFFFF))), at - full


@inner(forceinline=True)
def push_bits(value, count, state, at, out):
    """Write 1 to 16 raw bits as `push_symbol` writes a symbol."""
    bits = np.uint64(count)
    out[at - 1] = np.uint16(state & np.uint64(0xFFFF))
    full = (state >> (np.uint64(32) - bits)) != np.uint64(0)
    state = state >> np.uint64(16) if full else state
    return (state << bits) | np.uint64(value), at - full


@inner(forceinline=True)
def _push(operation, state, at, inverses, spans, out):
    if operation & np.uint32(RAW):
        return push_bits(operation & np.uint32(0xFFFF), (operation >> np.uint32(16)) & np.uint32(31), state, at, out)
    return push_symbol(operation, state, at, inverses, spans, out)


@inner(forceinline=True)
def put_states(first, second, at, out):
    """Write the states that a decoder begins with before all words; return the place of the first word."""
    for state in (second, first):
        out[at - 1] = np.uint16(state >> np.uint64(16))
        out[at - 2] = np.uint16(state & np.uint64(0xFFFF))
        at -= 2
    return at


@kernel
def write(operations, inverses, spans, out):
    """Write operations as words of 16 bits, from the end of `out` on, the states of the decoder first.

    Operations use one state and the other in turn, so that a processor can work on two at once.

    Args:
        operations: (M,) uint32: numbers of symbols, counted over all tables; or RAW, the number of raw bits from bit
            16 on, and the bits.
        inverses: (S,) uint64, 2^INVERSE over the size of each symbol, rounded up.
        spans: (S,) uint32, see `Decoder`; sizes are not 0 for symbols that occur.
        out: uint16, at least four more than operations.

    Returns:
        The place of the first word.
    """
    first = np.uint64(LEAST)
    second = np.uint64(LEAST)
    at = len(out)
    i = len(operations)
    if i & 1:
        i -= 1
        first, at = _push(operations[i], first, at, inverses, spans, out)
    while i > 0:
        second, at = _push(operations[i - 1], second, at, inverses, spans, out)
        first, at = _push(operations[i - 2], first, at, inverses, spans, out)
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
    """Write where each symbol begins in its table, and its size, from its weight.

    A table has TOTAL slots. A symbol with a weight has one slot, and of the rest its share.

    Args:
        weights: (S,) int64, 0 for symbols that do not occur.
        offsets: (K + 1,) int64, first symbol of each table.
        spans: (S,) uint32, first slot of each symbol, and from bit 16 on how many it has.
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
    """Write the symbol at each slot of each table that has a row."""
    for k in range(len(rows)):
        if rows[k] >= 0:
            for i in range(offsets[k], offsets[k + 1]):
                start = np.int64(spans[i] & np.uint32(0xFFFF))
                slots[rows[k], start : start + np.int64(spans[i] >> np.uint32(16))] = i
