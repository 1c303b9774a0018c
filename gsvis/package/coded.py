"""Encode the records and the terms of a part as bytes, and decode them; docs/design/041 has the measurements.

A part has a head of 16 bytes: "GSVc", the version of the code, the kind (0 Gaussians, 1 terms), the bits of a number of
terms, a zero, the number of rows, and the number of coder words that follow. In a part of Gaussians of version 1, the
lower bits of places follow the words. A part of version 2 has rounded records, all in its words. Probabilities start
anew in every part, so a part depends only on the rows of its chunks; terms of version 2 also on the records of their
Gaussians. This module does not read or write files.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis._kernels.records import logarithms
from gsvis._kernels.rounding import Limits
from gsvis.color.records import Grids
from gsvis.package._kernels import coded_records, coded_terms
from gsvis.package.codec import ChunkTable
from gsvis.package.layout import RECORD_BYTES, RecordLayout, TermLayout, term_fields
from gsvis.package.rounding import chunks_of, lights_of, sizes_of_intensities

__all__ = ["TermsLack", "decode_gaussians", "decode_terms", "encode_gaussians", "encode_terms", "memory_of"]

U8 = NDArray[np.uint8]
U32 = NDArray[np.uint32]

_HEAD = struct.Struct("<4sBBBBII")
_MAGIC = b"GSVc"
_VERSION = 1
_ROUNDED = 2  # version of a part of rounded Gaussians
_GAUSSIANS = 0
_TERMS = 1
_LEVELS = coded_records.DEPTH // 3
_NO_LIMITS = Limits(*(0 for _ in Limits._fields))
_NO_RULES = coded_terms.TermRules(False, 0, 0, 0, np.zeros(1, np.int64))
_NO_LIGHTS = np.zeros(0, np.int64)


@dataclass(frozen=True, eq=False)
class TermsLack:
    """What tells how many bits the terms of rounded records lack.

    Attributes:
        lights: (M,) int64, the light of the Gaussian of each term, see `lights_of`.
        rules: Rules of the scene.
    """

    lights: NDArray[np.int64]
    rules: coded_terms.TermRules

    @classmethod
    def from_records(
        cls, records: U8, counts: U8, table: ChunkTable, grids: Grids, limits: Limits | None
    ) -> TermsLack | None:
        """Return what is known of the terms of some Gaussians; None for records that have all bits.

        Args:
            records: (G, 16) uint8, the Gaussians.
            counts: (G,) uint8, number of terms of each.
            table: Rows of their chunks.
            grids: Tables of the terms.
            limits: How the records were rounded.
        """
        if limits is None:
            return None
        lights = lights_of(records, table, RecordLayout.from_variant(grids.variant), table.of_all())
        sizes = sizes_of_intensities(grids)
        rules = coded_terms.TermRules(True, limits.center, limits.decay, limits.intensity, sizes)
        return cls(np.repeat(lights, counts), rules)

    def of(self, low: int, high: int) -> TermsLack:
        """Return the same for the terms in [low, high)."""
        return TermsLack(self.lights[low:high], self.rules)


def memory_of(gaussians: int, terms: int, width: int) -> int:
    """Return the bytes of memory that decoded Gaussians and terms take; `width` are the bytes of a term's record."""
    return gaussians * (RECORD_BYTES + 1 + 6) + terms * (width + 1)


def encode_gaussians(
    records: U8, counts: U8, table: ChunkTable, layout: RecordLayout, limits: Limits | None = None
) -> bytes:
    """Encode Gaussians as the bytes of a part.

    Args:
        records: (G, 16) uint8; bits that the layout does not use are 0.
        counts: (G,) uint8, number of terms of each.
        table: Rows of their chunks.
        layout: Layout of the records.
        limits: How the records were rounded; None for records that have all bits.
    """
    low = np.zeros((len(records), 3), np.uint16)
    bits = _low_bits(table)
    pairs = np.ascontiguousarray(records).view("<u8").reshape(-1, 2)
    words = np.zeros(64 * len(records) + 8, np.uint32)
    count_bits = int(counts.max(initial=0)).bit_length()
    rows = _kernel_rows(table)
    fields = _kernel_fields(layout, count_bits, limits)
    used = coded_records.code(pairs, np.ascontiguousarray(counts), low, rows, fields, words, True)
    if limits is not None:
        return _join_part(_GAUSSIANS, count_bits, words[:used], len(records), _version(limits))
    packed = np.zeros(_packed_bytes(bits), np.uint8)
    coded_records.pack(low.reshape(-1), bits, packed)
    return _join_part(_GAUSSIANS, count_bits, words[:used], len(records)) + packed.tobytes()


def decode_gaussians(
    data: bytes, count: int, table: ChunkTable, layout: RecordLayout, limits: Limits | None = None
) -> tuple[U8, U8]:
    """Decode the records (G, 16) and the numbers of terms (G,) of a part; any result can be drawn.

    Args:
        data: Bytes of the part.
        count: G.
        table: Rows of the chunks of the part.
        layout: Layout of the records.
        limits: How the records were rounded; None for records that have all bits.

    Raises:
        ValueError: If the bytes are not such a part, or the number of Gaussians differs.
    """
    words, rest, count_bits = _split_part(data, _GAUSSIANS, count, _version(limits))
    bits = _low_bits(table)
    stored = _packed_bytes(bits) if limits is None else 0
    if len(bits) != 3 * count or len(rest) != stored:
        raise ValueError(f"expected the places of {count:,} Gaussians, got {len(rest):,} bytes")
    low = np.empty((count, 3), np.uint16)
    pairs = np.empty((count, 2), np.uint64)
    if limits is None:
        coded_records.unpack(rest, bits, low.reshape(-1))
    counts = np.empty(count, np.uint8)
    fields = _kernel_fields(layout, count_bits, limits)
    used = coded_records.code(pairs, counts, low, _kernel_rows(table), fields, words, False)
    if used != len(words):
        raise ValueError(f"expected {count:,} Gaussians in {len(words):,} words, got {_describe_words(used)}")
    return pairs.astype("<u8", copy=False).view(np.uint8).reshape(-1, RECORD_BYTES), counts


def encode_terms(records: U8, firsts: NDArray[np.bool_], layout: TermLayout, lacking: TermsLack | None = None) -> bytes:
    """Encode terms as the bytes of a part.

    Args:
        records: (M, B) uint8.
        firsts: (M,) whether each is the first term of its Gaussian.
        layout: Layout of the terms.
        lacking: What tells how many bits rounded terms lack; None for terms that have all bits.
    """
    words = np.zeros(32 * len(records) + 8, np.uint32)
    lights, rules = (_NO_LIGHTS, _NO_RULES) if lacking is None else (lacking.lights, lacking.rules)
    of = term_fields(layout)
    used = coded_terms.code(np.ascontiguousarray(records), firsts, lights, rules, of, words, True)
    return _join_part(_TERMS, 0, words[:used], len(records), _version(lacking))


def decode_terms(data: bytes, firsts: NDArray[np.bool_], layout: TermLayout, lacking: TermsLack | None = None) -> U8:
    """Decode the records (M, B) of the terms of a part; any result can be drawn.

    Args:
        data: Bytes of the part.
        firsts: (M,) whether each is the first term of its Gaussian.
        layout: Layout of the terms.
        lacking: What tells how many bits rounded terms lack; None for terms that have all bits.

    Raises:
        ValueError: If the bytes are not such a part, or the number of terms differs.
    """
    words, rest, _ = _split_part(data, _TERMS, len(firsts), _version(lacking))
    out = np.empty((len(firsts), layout.nbytes), np.uint8)
    if len(rest):
        raise ValueError(f"expected nothing behind the words of terms, got {len(rest):,} bytes")
    lights, rules = (_NO_LIGHTS, _NO_RULES) if lacking is None else (lacking.lights, lacking.rules)
    used = coded_terms.code(out, firsts, lights, rules, term_fields(layout), words, False)
    if used != len(words):
        raise ValueError(f"expected {len(firsts):,} terms in {len(words):,} words, got {_describe_words(used)}")
    return out


def _version(rounding: object) -> int:
    """Return the version of a part with this rounding; None for records that have all bits."""
    return _VERSION if rounding is None else _ROUNDED


def _describe_words(words: int) -> str:
    """Return the number of words that a decoder read, as text; it is below 0 for damaged words."""
    return f"{words:,} words" if words >= 0 else "damaged words"


def _join_part(kind: int, count_bits: int, words: U32, count: int, version: int = _VERSION) -> bytes:
    """Return the head and the words of a part."""
    return _HEAD.pack(_MAGIC, version, kind, count_bits, 0, count, len(words)) + words.astype("<u4").tobytes()


def _split_part(data: bytes, kind: int, count: int, expected: int = _VERSION) -> tuple[U32, U8, int]:
    """Return the words of a part, the bytes after them, and the bits of a number of terms.

    Raises:
        ValueError: If the head has a different kind or version, or more words than there are.
    """
    if len(data) < _HEAD.size:
        raise ValueError(f"expected a head of {_HEAD.size} bytes, got {len(data)}")
    magic, version, found, count_bits, zero, rows, words = _HEAD.unpack_from(data)
    if (magic, version, found, zero) != (_MAGIC, expected, kind, 0) or count_bits > 8 * (kind == _GAUSSIANS):
        raise ValueError(f"expected a part of kind {kind}, version {expected}, got {data[:8]!r}")
    end = _HEAD.size + 4 * words
    if rows != count or end > len(data):
        raise ValueError(f"expected {count:,} rows and at most {len(data):,} bytes, got {rows:,} and {end:,}")
    content = np.frombuffer(data, "<u4", words, _HEAD.size).astype(np.uint32)
    return content, np.frombuffer(data, np.uint8, offset=end), count_bits


def _low_bits(table: ChunkTable) -> U8:
    """Return the number of bits (3 G,) of each coordinate of a place that are below the octree."""
    below = np.maximum(table.bits, _LEVELS) - np.uint8(_LEVELS)
    return np.repeat(below, table.counts, axis=0).reshape(-1)


def _packed_bytes(bits: U8) -> int:
    """Return the bytes that values with these numbers of bits take."""
    return -(-int(bits.sum(dtype=np.int64)) // 8)


def _kernel_rows(table: ChunkTable) -> coded_records.Rows:
    """Return the rows of chunks as kernels take them."""
    chunks = chunks_of(table)
    return coded_records.Rows(chunks.lows, chunks.strides, table.counts.astype(np.int64), chunks.steps, chunks.bits)


def _kernel_fields(layout: RecordLayout, count_bits: int, limits: Limits | None) -> coded_records.Fields:
    """Return the layout of records as kernels take it; `count_bits` are those of a number of terms."""
    coarse = limits is not None
    colors = layout.packed_from - 1
    rounding = _NO_LIMITS if limits is None else limits
    return coded_records.Fields(*layout.bits, colors, count_bits, coarse, rounding, *logarithms())
