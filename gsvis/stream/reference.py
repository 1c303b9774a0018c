"""The codes of the wire in plain Python, one bit and one symbol at a time: slow twins of the kernels.

Bits are strings of 0 and 1.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.package.codec import ChunkTable

__all__ = [
    "PlainReader",
    "decode_values",
    "encode_values",
    "lay_out",
    "longest_step",
    "read_record",
    "read_term",
    "table_slots",
]


def encode_values(values: list[int], order: int) -> str:
    """Return values >= 0 as exponential Golomb codes of an order, bits in the order in which they are written.

    Examples:
        >>> encode_values([0, 1, 2], 0), encode_values([0, 5], 2)
        ('1010011', '10001100')
    """
    out = ""
    for value in values:
        lower = f"{value + (1 << order):b}"[1:][::-1]
        out += "0" * (len(lower) - order) + "1" + lower
    return out


def decode_values(bits: str, order: int, count: int) -> list[int]:
    """Return the first `count` values of a string of codes: the inverse of `encode_values`."""
    values = []
    at = 0
    for _ in range(count):
        zeros = bits.index("1", at) - at
        at += zeros + 1
        lower = bits[at : at + order + zeros][::-1]
        at += order + zeros
        values.append(int("1" + lower, 2) - (1 << order))
    return values


def lay_out(ids: NDArray[Any], of: NDArray[Any], known: NDArray[np.bool_]) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Return the chunks of ids that are not known yet, ascending, and which chunks are known after that.

    Args:
        ids: (G,) ids of Gaussians, ascending.
        of: (N,) the chunk of each Gaussian.
        known: (C,) whether each chunk is known.
    """
    after = known.copy()
    after[of[ids]] = True
    return np.flatnonzero(after & ~known), after


class PlainReader:
    """Decoder of coded records, one symbol at a time, as a client would write it.

    Args:
        data: Bytes of a row of records.
        tables: For each table, the number of slots of each symbol; an empty list for a table without symbols.

    Raises:
        ValueError: From all methods, if the bytes do not hold the symbols that are asked for.
    """

    def __init__(self, data: bytes, tables: list[list[int]]) -> None:
        if len(data) < 8 or len(data) % 2:
            raise ValueError("data: expected words of 16 bits, at least four")
        self._words = [data[k] | data[k + 1] << 8 for k in range(0, len(data), 2)]
        self._tables = tables
        self._state = self._words[0] | self._words[1] << 16
        self._other = self._words[2] | self._words[3] << 16
        self._at = 4

    def symbol(self, table: int) -> int:
        """Return the next symbol, which is one of a table."""
        slot = self._state & 4095
        start = 0
        for symbol, size in enumerate(self._tables[table]):
            if start <= slot < start + size:
                self._refill(size * (self._state >> 12) + slot - start)
                return symbol
            start += size
        raise ValueError(f"table {table}: expected one with symbols")

    def bits(self, count: int) -> int:
        """Return the next `count` raw bits; 0 bits read nothing."""
        if count == 0:
            return 0
        found = self._state & ((1 << count) - 1)
        self._refill(self._state >> count)
        return found

    def end(self) -> None:
        """Raise unless all words are used and both states are back at the encoder's start."""
        if self._at != len(self._words) or (self._state, self._other) != (1 << 16, 1 << 16):
            raise ValueError("data: expected no more words")

    def _refill(self, state: int) -> None:
        """Read a word into a state that is too small, and swap the two states."""
        if state < 1 << 16:
            if self._at == len(self._words):
                raise ValueError("data: expected more words")
            state = state << 16 | self._words[self._at]
            self._at += 1
        self._state = self._other
        self._other = state


def table_slots(levels: list[int]) -> list[int]:
    """Return how many of the 4096 slots of a table each symbol gets, from the levels of the symbols."""
    weights = [(4 + (level - 1) % 4) << ((level - 1) // 4) if level else 0 for level in levels]
    total = sum(weights)
    used = sum(weight > 0 for weight in weights)
    ends = [0]
    for k in range(len(weights)):
        seen = sum(weight > 0 for weight in weights[: k + 1])
        ends.append(sum(weights[: k + 1]) * (4096 - used) // total + seen if total else 0)
    return [high - low for low, high in pairwise(ends)]


def read_record(
    reader: PlainReader,
    bits: tuple[int, int, int],
    chunk: tuple[ChunkTable, int],
    before: tuple[int, int] | None,
    limits: tuple[int, int] | None = None,
) -> tuple[bytes, int]:
    """Return the next record of a Gaussian with three bytes of color, and its strength.

    Args:
        reader: Its next symbol is the first of the record.
        bits: Bits of a coordinate, of a component of the quaternion, and of a log-scale.
        chunk: A table, and the row of its chunk.
        before: Distance of the id from the last one in the same chunk, and the strength of that; None if there is none.
        limits: `Steps` of the scene; None if all bits are sent.
    """
    position, rotation, scale = bits
    table, row = chunk
    low = int(table.lows[row])
    stride = int(table.strides[row])
    opacity, order, middle, smallest = (reader.symbol(k) for k in range(4))
    a = -middle * stride
    b = -smallest * stride
    weight = _logarithm(opacity) + _add_logarithms(_add_logarithms(a, b), a + b)
    if before is None:
        top = reader.symbol(4)
    else:
        near, strength = before
        top = reader.symbol(5 + min(near.bit_length() - 1, 5))
        if top == 63:
            top = reader.bits(scale)
        else:
            expected = ((strength - weight) // 2 - low) // stride
            top += min(max(expected, 0), 2**scale - 1) - 47
    scales = [0, 0, 0]
    largest = order // 2
    half = 2 ** (rotation - 1) - 1
    rest = [k for k in range(3) if k != largest]
    scales[largest] = top % 2**scale
    scales[rest[order % 2]] = (top - middle) % 2**scale
    scales[rest[1 - order % 2]] = (top - smallest) % 2**scale
    size = low + scales[largest] * stride
    turn = 0 if limits is None else min(max((limits[1] - (2 * size + middle * stride) // 4) // 64, 0), 7)
    turns = [(((reader.symbol(11 + 8 * k + turn) - half) << turn) + half) % 2**rotation for k in range(3)]
    second = reader.symbol(35)
    first = reader.symbol(36 + second // 32)
    third = reader.symbol(44 + min(max(((first + 128) % 256 - 128) // 4, -8), 8) + 8)
    word = 0
    for k in range(3):
        wide = left = int(table.bits[row, k])
        if limits is not None:
            limit = min(limits[0] - (middle * stride) // 2 - _logarithm(opacity), size - middle * stride) // 64
            left -= min(max(limit - longest_step(table, row, k), 0), wide)
        place = reader.bits(left) << (wide - left)
        field = place | turns[k] << position | scales[k] << (position + rotation)
        word |= field << (k * sum(bits))
    color = bytes([opacity, (first + second) % 256, second, (third + second) % 256])
    return color + word.to_bytes(12, "little"), 2 * size + weight


def longest_step(table: ChunkTable, row: int, axis: int) -> int:
    """Return log2 of the longest step of a coordinate, rounded up; at least -126, and -127 for a step of 0.

    Args:
        table: Rows of chunks.
        row: One of them.
        axis: 0, 1 or 2.
    """
    step = float(table.steps[row, axis])
    origin = float(table.origins[row, axis])
    fraction, exponent = math.frexp(abs(step))
    found: int = -127 if step == 0 else max(exponent - 1 + (fraction > 0.5), -126)
    if step >= 0:
        return found
    end = origin - step * (2 ** int(table.bits[row, axis]) - 1)
    return int(found + math.ceil(max(abs(origin), abs(end)) * math.log2(math.e)))


def _logarithm(opacity: int) -> int:
    """Return 64 log2 of an opacity of 0 to 255, rounded."""
    return round(64 * math.log2(max(opacity, 1)))


def _add_logarithms(a: int, b: int) -> int:
    """Return the logarithm of a sum from those of its parts; all are 64 log2."""
    return max(a, b) + round(64 * math.log2(1 + 2 ** (-abs(a - b) / 64)))


def read_term(reader: PlainReader, before: int | None) -> tuple[int, int]:
    """Return the next term of 36 bits, and its leading intensity.

    Args:
        reader: Its next symbol is the first of the term.
        before: Leading intensity of the term before, if it belongs to the same Gaussian; None otherwise.
    """
    lead = reader.symbol(70 if before is None else 71 + before // 8)
    decay = reader.symbol(79 + lead // 8)
    polar = reader.symbol(87)
    azimuth = reader.symbol(88 + polar // 8)
    first = reader.symbol(96 + lead // 4)
    last = reader.symbol(112 + min(max((first + 32) % 64 - 32, -6), 6) + 6)
    parts = polar, azimuth, decay, (first + lead) % 64, lead, (last + lead) % 64
    word = 0
    shift = 0
    for value, width in zip(parts, (6, 7, 5, 6, 6, 6), strict=True):
        word |= value << shift
        shift += width
    return word, lead
