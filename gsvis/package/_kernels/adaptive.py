"""Kernels of the coder of parts: an arithmetic coder of bits with adaptive probabilities, and trees of bits for values.

The same function writes and reads. The state is three numbers: the lowest value (when reading: the value read minus the
lowest), the range, and the place of the next word. A probability has 25 bits; the 7 bits below count the bits it has
coded. With each bit it moves toward that bit, by about one over the count. All arithmetic is in integers. Reading
beyond the end gives zeros.

References:
    Rissanen and Langdon, "Arithmetic coding", IBM Journal of Research and Development 23(2), 1979; Mahoney, "Adaptive
    weighing of context models for lossless data compression", Florida Tech CS-2005-16, section 2 (adaptive bits).
"""

from __future__ import annotations

import numpy as np

from gsvis._kernels.compiled import inner, kernel

START = 1 << 31  # a probability of one half with a count of 0
TAIL = 2  # words after the last bit
_MOST = 127  # largest count of a probability
_SURE = (1 << 25) - 1  # probability 1
_RATES = np.array([131072 // (2 * seen + 3) for seen in range(_MOST + 1)], np.int64)
_WORD = np.uint64(32)
_LEAST = np.uint64(1 << 32)
_FULL = np.uint64((1 << 64) - 1)
_WHOLE = np.uint32(0xFFFFFFFF)


@kernel
def begin(data, writing):
    """Return the state before the first bit."""
    if writing:
        return np.uint64(0), _FULL, 0
    low = np.uint64(0)
    for k in range(2):
        low = low << _WORD | (np.uint64(data[k]) if k < len(data) else np.uint64(0))
    return low, _FULL, 2


@kernel
def end(low, at, data, writing):
    """Write the last words; return the number of words, or -1 if not all words were read."""
    if not writing:
        return at if at == len(data) else -1
    data[at] = np.uint32(low >> _WORD)
    data[at + 1] = np.uint32(low & np.uint64(0xFFFFFFFF))
    return at + TAIL


@inner(forceinline=True)
def carry(data, at):
    """Add one to the number that the words before `at` spell, because the lowest value went beyond 64 bits."""
    last = at - 1
    while data[last] == _WHOLE:
        data[last] = np.uint32(0)
        last -= 1
    data[last] += np.uint32(1)


@inner(forceinline=True)
def code_tree(low, span, at, chances, start, value, bits, data, writing):
    """Write or read a value of `bits` bits, highest first, with 2^bits probabilities from `start` on.

    Args:
        low: Lowest value of the state.
        span: Range of the state.
        at: Place of the next word.
        chances: (P,) uint32 probabilities; updated.
        start: First probability.
        value: The value; ignored when reading.
        bits: Number of its bits.
        data: (W,) uint32, the words; long enough when writing.
        writing: Whether to write.

    Returns:
        The value, and the new `low`, `span` and `at`.
    """
    if not writing:
        return _read_tree(low, span, at, chances, start, bits, data)
    node = np.int64(1)
    for k in range(bits - 1, -1, -1):
        held = np.int64(chances[start + node])
        seen = held & _MOST
        whole = held >> 7
        bit = value >> k & 1
        part = (span >> np.uint64(16)) * np.uint64(held >> 16 | 1)
        if bit:
            span = part
        else:
            span = span - part
            low = low + part
            if low < part:
                carry(data, at)
        whole += ((bit * _SURE - whole) * _RATES[seen]) >> 16
        chances[start + node] = np.uint32(whole << 7 | min(seen + 1, _MOST))
        if span < _LEAST:
            data[at] = np.uint32(low >> _WORD)
            low = low << _WORD
            span = span << _WORD
            at = at + 1
        node = node << 1 | bit
    return node - (1 << bits), low, span, at


@inner(forceinline=True)
def _read_tree(low, span, at, chances, start, bits, data):
    """Read a value; see `code_tree`. No branch depends on a bit, because processors cannot predict it."""
    node = np.uint64(1)
    first = np.uint64(start)
    for _ in range(bits):
        held = np.uint64(chances[first + node])
        seen = held & np.uint64(_MOST)
        whole = np.int64(held >> np.uint64(7))
        part = (span >> np.uint64(16)) * (held >> np.uint64(16) | np.uint64(1))
        bit = low < part
        low, span = (low, part) if bit else (low - part, span - part)
        whole += (((_SURE if bit else 0) - whole) * _RATES[seen]) >> 16
        chances[first + node] = np.uint32(np.uint64(whole) << np.uint64(7) | min(seen + np.uint64(1), np.uint64(_MOST)))
        if span < _LEAST:
            low = low << _WORD | (np.uint64(data[at]) if at < len(data) else np.uint64(0))
            span = span << _WORD
            at = at + 1
        node = node << np.uint64(1) | np.uint64(bit)
    return np.int64(node) - (1 << bits), low, span, at


@inner(forceinline=True)
def code_raw(low, span, at, value, bits, data, writing):
    """Write or read a value of 0 to 16 bits, all values alike; arguments and result as for `code_tree`."""
    span = span >> np.uint64(bits)
    if writing:
        part = span * np.uint64(value)
        low = low + part
        if low < part:
            carry(data, at)
    else:
        value = min(np.int64(low // span), (np.int64(1) << bits) - 1)
        low = low - span * np.uint64(value)
    if span < _LEAST:
        span = span << _WORD
        if writing:
            data[at] = np.uint32(low >> _WORD)
            low = low << _WORD
        else:
            low = low << _WORD | (np.uint64(data[at]) if at < len(data) else np.uint64(0))
        at = at + 1
    return value, low, span, at
