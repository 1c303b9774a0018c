"""Tables of the coder: the rounded frequency of each symbol of a scene, sent as text in WELCOME.

A symbol has a level from 0 to 49: level 0 if it does not occur; levels from 1 on stand for the weights 4, 5, 6, 7, 8,
10, 12, 14, 16, ... A table has 4096 slots. Each symbol that occurs gets one slot and, by weight, a share of the rest.
"""

from __future__ import annotations

import base64
import binascii
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis.errors import ProtocolError
from gsvis.stream._kernels import coder
from gsvis.stream._kernels import ids as codes

__all__ = ["MOST_LEVEL", "Tables"]

U8 = NDArray[np.uint8]
I64 = NDArray[np.int64]

MOST_LEVEL = 49
"""Level of the largest weight: one symbol that fills its table."""

_WEIGHTS = np.array([0, *((4 + (m & 3)) << (m >> 2) for m in range(MOST_LEVEL))], np.int64)


@dataclass(frozen=True, eq=False)
class Tables:
    """K tables of S symbols in all.

    Attributes:
        offsets: (K + 1,) int64, first symbol of each table.
        levels: (S,) uint8, level of each symbol.
        inverses: (S,) uint64, for encoding; see `coder.write`.
        decoder: For decoding.
    """

    offsets: I64
    levels: U8
    inverses: NDArray[np.uint64]
    decoder: coder.Decoder

    @classmethod
    def from_levels(cls, levels: U8, sizes: list[int]) -> Tables:
        """Return tables from the levels of all symbols and the number of symbols of each table."""
        offsets = np.concatenate([np.zeros(1, np.int64), np.cumsum(sizes, dtype=np.int64)])
        spans = np.empty(len(levels), np.uint32)
        coder.fill(_WEIGHTS[levels], offsets, spans)
        used = np.add.reduceat(levels, offsets[:-1], dtype=np.int64) > 0
        rows = np.where(used, np.cumsum(used) - 1, -1).astype(np.int32)
        slots = np.zeros((max(int(used.sum()), 1), coder.TOTAL), np.uint16)
        coder.fill_slots(offsets, spans, rows, slots)
        sizes_of = np.maximum(spans >> 16, 1).astype(np.uint64)
        inverses = ((np.uint64(1) << np.uint64(coder.INVERSE)) - np.uint64(1)) // sizes_of + np.uint64(1)
        return cls(offsets, levels, inverses, coder.Decoder(slots, rows, offsets, spans))

    @classmethod
    def from_counts(cls, counts: I64, sizes: list[int]) -> Tables:
        """Return tables from the counts of all symbols and the number of symbols of each table."""
        offsets = np.concatenate([np.zeros(1, np.int64), np.cumsum(sizes, dtype=np.int64)])
        totals = np.repeat(np.add.reduceat(counts, offsets[:-1]), sizes)
        wanted = 4.0 * coder.TOTAL * counts / np.maximum(totals, 1)
        middles = np.sqrt(_WEIGHTS[1:-1].astype(np.float64) * _WEIGHTS[2:])
        levels = np.where(counts > 0, 1 + np.searchsorted(middles, wanted), 0)
        return cls.from_levels(levels.astype(np.uint8), sizes)

    def part(self, first: int, count: int) -> coder.Decoder:
        """Return `count` tables from table `first` on, for decoding."""
        code = self.decoder
        some = slice(first, first + count)
        return code._replace(rows=code.rows[some], offsets=code.offsets[first : first + count + 1])

    def to_text(self) -> str:
        """Return the tables in base64."""
        out = np.zeros(8 * len(self.levels) + 8 * len(self.offsets) + 64, np.uint8)
        bit = 0
        for low, high in zip(self.offsets[:-1].tolist(), self.offsets[1:].tolist(), strict=True):
            used = np.flatnonzero(self.levels[low:high])
            if len(used) == 0:
                bit = codes.write(np.zeros(1, np.int64), 0, out, bit)
                continue
            first = int(used[0])
            count = int(used[-1] - used[0]) + 1
            steps = _encode_steps(self.levels[low + first : low + first + count])
            order = int(codes.best_order(steps))
            bit = codes.write(np.array([1 + order, first, count - 1]), 0, out, bit)
            bit = codes.write(steps, order, out, bit)
        return base64.b64encode(out[: -(-bit // 8)].tobytes()).decode()

    @classmethod
    def from_text(cls, text: str, sizes: list[int]) -> Tables:
        """Return the tables that `to_text` wrote.

        Raises:
            ProtocolError: If the text does not hold valid tables.
        """
        try:
            data = np.frombuffer(base64.b64decode(text, validate=True), np.uint8)
        except (binascii.Error, ValueError) as error:
            raise ProtocolError(f"tables: expected base64, got {text[:40]!r}") from error
        levels = np.zeros(sum(sizes), np.uint8)
        bit = 0
        at = 0
        for size in sizes:
            head = np.empty(1, np.int64)
            found = np.empty(2, np.int64)
            bit = codes.read(data, bit, 0, head)
            if bit >= 0 and head[0]:
                bit = codes.read(data, bit, 0, found)
                first = int(found[0])
                count = int(found[1]) + 1
                if bit < 0 or head[0] > 9 or first + count > size:
                    bit = -1
                    break
                steps = np.empty(count, np.int64)
                bit = codes.read(data, bit, int(head[0]) - 1, steps)
                values = _decode_steps(steps)
                if bit < 0 or values[steps > 0].min(initial=1) < 1 or values.max() > MOST_LEVEL:
                    bit = -1
                    break
                levels[at + first : at + first + count] = values
            if bit < 0:
                break
            at += size
        if bit < 0 or -(-bit // 8) != len(data):
            got = f"{len(data):,} bytes that hold less, more, or levels out of range"
            raise ProtocolError(f"tables: expected levels of all symbols, from 1 to {MOST_LEVEL}, got {got}")
        return cls.from_levels(levels, sizes)


def _encode_steps(levels: U8) -> I64:
    """Return 0 for each level 0, else 1 plus the zigzag-encoded difference from the last level that is not 0."""
    values = np.zeros(len(levels), np.int64)
    used = levels > 0
    steps = np.diff(levels[used].astype(np.int64), prepend=0)
    values[used] = 1 + np.where(steps >= 0, 2 * steps, -2 * steps - 1)
    return values


def _decode_steps(values: I64) -> I64:
    """Return the levels that `_encode_steps` encoded."""
    levels = np.zeros(len(values), np.int64)
    used = values > 0
    steps = values[used] - 1
    levels[used] = np.cumsum(np.where(steps & 1, -((steps + 1) >> 1), steps >> 1))
    return levels
