"""Encode and decode the records of a batch with an entropy coder, by tables of symbol frequencies of the scene.

A server computes the tables once from all records of a scene and sends them in WELCOME. Coded rows are words of 16
bits. The code is lossless; with a `Quality`, records are rounded before.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np
from numpy.typing import NDArray

from gsvis._kernels.records import logarithms
from gsvis._kernels.rounding import TURNS
from gsvis._kernels.terms import TermFields
from gsvis.color.records import Grids
from gsvis.package.contents import Contents
from gsvis.package.layout import RecordLayout, TermLayout, term_fields
from gsvis.package.rounding import Chunks, Limits, Quality, chunks_of, limits_of, round_records
from gsvis.stream._kernels import coder, records, terms
from gsvis.stream.tables import Tables

__all__ = ["Coding", "Steps", "coarsen", "table_sizes"]

U8 = NDArray[np.uint8]
U64 = NDArray[np.uint64]
I64 = NDArray[np.int64]

_CLOSE = (1, 2, 5, 11, 22, 48)  # a typical distance of ids for each table of largest scales
_PIECE = 1 << 16  # records that are counted at a time


@dataclass(frozen=True)
class Steps:
    """Limits that decide which low bits of the records of a scene are not sent; clients get them in WELCOME.

    Attributes:
        place: Limit of the steps of coordinates, 1/64 octaves of scene units.
        turn: Limit of the dropped bits of quaternions, 1/64 bits.
    """

    place: int
    turn: int

    @classmethod
    def from_limits(cls, limits: Limits) -> Steps:
        """Return what a client has to know of how records are rounded."""
        return cls(limits.place, limits.turn)


@dataclass(frozen=True, eq=False)
class Coding:
    """The code of the records of one scene.

    Attributes:
        grids: Tables of base colors and terms.
        steps: Bits that are not sent; None if records are sent whole.
        tables: Tables of the coder.
    """

    grids: Grids
    steps: Steps | None
    tables: Tables

    @classmethod
    def from_contents(cls, contents: Contents, steps: Steps | None = None) -> Coding:
        """Return the code for the records of a package; with `steps`, `coarsen` has rounded them."""
        blank = cls.blank(contents.grids, steps)
        return blank.filled(blank.count(contents))

    @classmethod
    def blank(cls, grids: Grids, steps: Steps | None) -> Coding:
        """Return a code whose tables are empty, to count symbols with."""
        sizes = table_sizes(grids)
        return cls(grids, steps, Tables.from_levels(np.zeros(sum(sizes), np.uint8), sizes))

    def filled(self, counts: I64) -> Coding:
        """Return the code for symbols (S,) with these counts."""
        counts = counts.copy()
        offsets = self.tables.offsets
        leads = records.TABLES + terms.LEAD
        for first, last in ((records.FIRST, records.ROTATION), (leads, leads + 9)):
            counts[offsets[first] : offsets[last]] += 1  # in a batch, any symbol of these tables can occur
        return replace(self, tables=Tables.from_counts(counts, table_sizes(self.grids)))

    def count(self, contents: Contents) -> I64:
        """Return how often each symbol (S,) occurs in records, which were rounded with the same steps."""
        counts = np.zeros(len(self.tables.levels), np.int64)
        ids = np.arange(len(contents))
        chunks = chunks_of(contents.table)
        some = ids[:: 1 + len(ids) // _PIECE]
        places = some - contents.table.starts[contents.chunks[some]]
        apart = some[np.argsort(places, kind="stable")]  # no two neighbors from one chunk
        for chosen in (*(ids[::distance] for distance in _CLOSE), apart):
            for low in range(0, len(chosen), _PIECE):
                part = chosen[low : low + _PIECE]
                rows = contents.chunks[part]
                coder.count(self._record_operations(contents.records[part], part, rows, chunks), counts)
        owners = np.repeat(np.arange(len(contents), dtype=np.int32), contents.term_counts)
        for low in range(0, len(owners), _PIECE):
            of = owners[low : low + _PIECE].copy()
            coder.count(self._term_operations(contents.term_records[low : low + len(of)].copy(), of), counts)
        return counts

    @cached_property
    def layout(self) -> records.Layout:
        """Layout of the records, for kernels."""
        return layout_of(self.grids, self.steps)

    @cached_property
    def fields(self) -> TermFields:
        """Bits of the fields of terms."""
        return term_fields(TermLayout.from_grids(self.grids))

    def mean_bytes(self, contents: Contents, *, most: int = _PIECE) -> tuple[float, float]:
        """Return the mean coded bytes of a Gaussian and of a term, without ids, from at most `most` records of each."""
        ids = np.arange(0, len(contents), 2)[:most]
        found = self.encode_records(contents.records[ids], ids, contents.chunks[ids], chunks_of(contents.table))
        owners = np.repeat(np.arange(len(contents), dtype=np.int32), contents.term_counts)[:most]
        of_terms = self.encode_terms(contents.term_records[: len(owners)].copy(), owners)
        return len(found) / len(ids) if len(ids) else 16.0, len(of_terms) / len(owners) if len(owners) else 4.0

    def encode_records(self, rows: U8, ids: I64, of: NDArray[np.int32], chunks: Chunks) -> U8:
        """Encode the records of G Gaussians.

        Args:
            rows: (G, 16) uint8.
            ids: (G,) ids, ascending.
            of: (G,) row of the chunk of each Gaussian.
            chunks: Rows of chunks.
        """
        return self._write_operations(self._record_operations(rows, ids, of, chunks))

    def split_records(self, contents: Contents) -> NDArray[np.uint16]:
        """Return all records of a package, split into fields (N, 16) uint16 for `encode_some`."""
        return self._split_rows(contents.records, contents.chunks, chunks_of(contents.table))

    def encode_some(
        self, parts: NDArray[np.uint16], ids: NDArray[np.int32], of: NDArray[np.int32], chunks: Chunks
    ) -> U8:
        """Encode the records of some Gaussians; the same bytes as from `encode_records`.

        Args:
            parts: (N, 16) uint16, all records of the package, from `split_records`.
            ids: (G,) ids, ascending.
            of: (G,) row of the chunk of each Gaussian.
            chunks: Rows of chunks.
        """
        if not len(ids):
            return np.zeros(0, np.uint8)
        out = np.empty(records.MOST_OPERATIONS * len(ids) + 4, np.uint16)
        code = self.tables
        spans = code.decoder.spans
        first = records.write(parts, ids, of, chunks, self.layout, code.offsets, code.inverses, spans, out)
        return out[first:].view(np.uint8)

    def decode_records(self, data: U8, ids: I64, of: NDArray[np.int32], chunks: Chunks) -> U8 | None:
        """Decode records of G Gaussians, (G, 16) uint8; None if the bytes are not such records."""
        out = np.empty((len(ids), 2), np.uint64)
        words = _short_words(data)
        if not len(ids):
            return _to_bytes(out) if len(data) == 0 else None
        code = self.tables.part(0, records.TABLES)
        good = words is not None and records.read(words, ids, of, chunks, self.layout, code, out)
        return _to_bytes(out) if good else None

    def encode_terms(self, rows: U8, owners: NDArray[np.int32]) -> U8:
        """Encode records of terms, (M, B) uint8; `owners` (M,) never decrease."""
        return self._write_operations(self._term_operations(rows, owners))

    def encode_some_terms(self, rows: U8, ids: NDArray[np.uint32], owners: NDArray[np.int32]) -> U8:
        """Encode the records of some terms; the same bytes as from `encode_terms`.

        Args:
            rows: (T, B) uint8, all records of the package.
            ids: (M,) ids, ascending.
            owners: (M,) int32, the Gaussian of each, never decreasing.
        """
        if not len(ids):
            return np.zeros(0, np.uint8)
        out = np.empty(terms.MOST_OPERATIONS * len(ids) + 4, np.uint16)
        code = self.tables
        offsets = code.offsets[records.TABLES :]
        spans = code.decoder.spans
        first = terms.write(rows, ids, owners, self.fields, offsets, code.inverses, spans, out)
        return out[first:].view(np.uint8)

    def decode_terms(self, data: U8, owners: I64) -> U8 | None:
        """Decode records of M terms, (M, B) uint8; None if the bytes are not such records."""
        out = np.empty((len(owners), TermLayout.from_grids(self.grids).nbytes), np.uint8)
        words = _short_words(data)
        if not len(owners):
            return out if len(data) == 0 else None
        code = self.tables.part(records.TABLES, terms.TABLES)
        good = words is not None and terms.read(words, owners, self.fields, code, out)
        return out if good else None

    def _record_operations(self, rows: U8, ids: I64, of: NDArray[np.int32], chunks: Chunks) -> NDArray[np.uint32]:
        """Return the operations of the coder for records; arguments as for `encode_records`."""
        out = np.empty(records.MOST_OPERATIONS * len(rows), np.uint32)
        parts = self._split_rows(rows, of, chunks)
        return out[: records.operations(parts, ids, of, chunks, self.layout, self.tables.offsets, out)]

    def _split_rows(self, rows: U8, of: NDArray[np.int32], chunks: Chunks) -> NDArray[np.uint16]:
        """Return records (G, 16) uint8 split into fields (G, 16) uint16."""
        out = np.empty((len(rows), records.ROW), np.uint16)
        offsets = self.tables.offsets
        assert offsets[records.TABLES] <= 1 << 16, "symbols of records have 16 bits"
        records.split(_to_words(rows), of, chunks, self.layout, offsets, out)
        return out

    def _term_operations(self, rows: U8, owners: NDArray[np.int32]) -> NDArray[np.uint32]:
        """Return the operations of the coder for terms; arguments as for `encode_terms`."""
        out = np.empty(terms.MOST_OPERATIONS * len(rows), np.uint32)
        offsets = self.tables.offsets[records.TABLES :]
        return out[: terms.operations(np.ascontiguousarray(rows), owners, self.fields, offsets, out)]

    def _write_operations(self, operations: NDArray[np.uint32]) -> U8:
        """Return the bytes that the coder writes for operations."""
        if not len(operations):
            return np.zeros(0, np.uint8)
        out = np.empty(len(operations) + 4, np.uint16)
        code = self.tables
        return out[coder.write(operations, code.inverses, code.decoder.spans, out) :].view(np.uint8)


def coarsen(contents: Contents, quality: Quality) -> tuple[Contents, Steps]:
    """Return rounded records, and which of their bits are not sent. Logarithmic chunks become linear boxes.

    Args:
        contents: The records of a package.
        quality: How to round.
    """
    limits = limits_of(contents, quality)
    return round_records(contents, limits, stated=False), Steps.from_limits(limits)


def layout_of(grids: Grids, steps: Steps | None) -> records.Layout:
    """Return the layout of the records of a scene, for kernels."""
    of = RecordLayout.from_variant(grids.variant)
    limits = steps or Steps(0, 0)
    colors = of.packed_from - 1
    return records.Layout(
        *of.bits, colors, steps is not None, limits.place, limits.turn, *logarithms(), _differences(colors == 3)
    )


@cache
def _differences(signed: bool) -> NDArray[np.int32]:
    """Return the table (256,) for the third component of a color, by the value of the second, signed or not."""
    values = np.arange(256)
    near = np.clip(((values + 128) % 256 - 128) >> 2, -8, 8) + 8
    return (near if signed else values >> 4).astype(np.int32)


def table_sizes(grids: Grids) -> list[int]:
    """Return the number of symbols of each table."""
    of = RecordLayout.from_variant(grids.variant)
    term = TermLayout.from_grids(grids)
    scale = 1 << of.scale
    turn = 1 << of.rotation
    center = min(term.theta, 6)
    strength = 1 << min(term.intensity, 6)
    return [
        256,
        6,
        scale,
        scale,
        scale,
        *[records.STEPS] * 6,
        *[turn] * (3 * TURNS),
        *[256] * 34,
        1 << min(term.function, 6),
        *[strength] * 9,
        *[1 << min(term.decay, 6)] * 8,
        1 << center,
        *[1 << min(term.phi, 7)] * 8,
        *[strength] * 29,
    ]


def _to_words(rows: U8) -> U64:
    """Return records (N, 16) uint8 as (N, 2) uint64."""
    return np.ascontiguousarray(rows).view("<u8").reshape(-1, 2)


def _to_bytes(words: U64) -> U8:
    """Return records (N, 2) uint64 as (N, 16) uint8."""
    return words.view(np.uint8).reshape(-1, 16)


def _short_words(data: U8) -> NDArray[np.uint16] | None:
    """Return bytes as words of 16 bits; None if their number is odd."""
    return np.frombuffer(data.tobytes(), "<u2") if len(data) % 2 == 0 else None
