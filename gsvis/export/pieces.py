"""Encode pieces of a static scene: Gaussians and terms that a page decodes without any other file.

A piece has a head of 24 bytes, compressed columns (the rows of the chunks, which of their Gaussians are here, owners of
terms, labels of harmonics), and records and terms coded as on the wire. docs/static.md describes it to the byte.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.export.columns import column, compress, differences
from gsvis.jobs.in_order import in_order
from gsvis.package.codec import packed_bits
from gsvis.package.contents import Contents
from gsvis.package.rounding import chunks_of
from gsvis.stream.coding import Coding

__all__ = ["PieceCoder", "place"]

U8 = NDArray[np.uint8]
I64 = NDArray[np.int64]

HEAD = struct.Struct("<6I")
"""Bytes of columns, Gaussians, chunks, terms, bytes of records, bytes of terms."""


def place(contents: Contents, ids: I64) -> Contents:
    """Return the Gaussians `ids` (M,) as a package of its own, whose Gaussian i is `ids[i]`.

    Args:
        contents: A package.
        ids: All ids of some chunks, chunk after chunk.
    """
    counts = contents.term_counts[ids]
    before = np.cumsum(counts, dtype=np.int64) - counts
    rows = np.repeat(contents.term_offsets[ids] - before, counts) + np.arange(counts.sum(dtype=np.int64))
    chunks = np.unique(contents.chunks[ids])
    return Contents(
        contents.names,
        contents.table[chunks],
        contents.chunk_levels[chunks],
        contents.records[ids],
        counts,
        contents.term_records[rows],
        contents.grids,
        np.array([0, len(ids)]),
        contents.facts,
        contents.limits,
    )


@dataclass(frozen=True, eq=False)
class PieceCoder:
    """Encodes pieces of one scene.

    Attributes:
        contents: The scene, with the ids of the static form.
        coding: The code of its records.
        labels: (N,) the set of higher coefficients of each Gaussian of a bare scene; None elsewhere.
        label_bytes: Bytes that name a set.
    """

    contents: Contents
    coding: Coding
    labels: I64 | None = None
    label_bytes: int = 0

    def encode(self, ids: I64, terms: I64 | None = None, known: NDArray[np.bool_] | None = None) -> bytes:
        """Return a piece.

        Args:
            ids: (G,) ascending ids of the Gaussians in it.
            terms: (M,) ascending numbers of the terms in it; None means none.
            known: (C,) whether pieces before it in the same file have the row of each chunk; those of this one are
                added. None means that it has all rows.
        """
        some = np.zeros(0, np.int64) if terms is None else terms
        of = self.contents.chunks[ids]
        chunks, counts = np.unique(of.astype(np.int64), return_counts=True)
        columns = [*self._chunk_columns(chunks, counts, known), *self._member_columns(ids, of, counts)]
        owners = self._owners[some]
        columns += [column(differences(owners), 4), column(self._skips(some, owners), 1)]
        if self.labels is not None:
            columns.append(column(self.labels[ids], self.label_bytes))
        head = compress(*columns)
        records = self.coding.encode_some(self._fields, ids.astype(np.int32), of, self._chunks).tobytes()
        rows = self.contents.term_records[some]
        coded = self.coding.encode_terms(rows, owners.astype(np.int32)).tobytes()
        sizes = HEAD.pack(len(head), len(ids), len(chunks), len(some), len(records), len(coded))
        return sizes + head + records + coded

    def encode_all(self, pieces: Iterable[I64]) -> list[bytes]:
        """Return a piece for each array of ascending ids, by several threads."""
        self._fields  # noqa: B018  threads share what is found once
        self._chunks  # noqa: B018
        self._owners  # noqa: B018
        return list(in_order(self.encode, pieces))

    def encode_terms(self, ids: I64) -> bytes:
        """Return a piece with all terms of Gaussians `ids` (G,), ascending, and without these."""
        offsets = self.contents.term_offsets
        counts = self.contents.term_counts[ids].astype(np.int64)
        before = np.cumsum(counts) - counts
        terms = np.repeat(offsets[ids] - before, counts) + np.arange(counts.sum())
        return self.encode(np.zeros(0, np.int64), terms)

    def _chunk_columns(self, chunks: I64, counts: I64, known: NDArray[np.bool_] | None) -> list[bytes]:
        """Return the columns of the rows of chunks; a stride of 0 stands for a row that is known."""
        table = self.contents.table
        fresh = np.ones(len(chunks), np.bool_)
        if known is not None:
            fresh = ~known[chunks]
            known[chunks] = True
        floats = np.concatenate([table.origins[chunks], table.steps[chunks]], axis=1).view(np.uint32)
        rows = np.where(fresh[:, None], floats, 0).astype(np.int64)
        return [
            column(differences(table.starts[chunks]), 4),
            column(counts - 1, 1),
            *(column(rows[:, k], 4) for k in range(6)),
            column(np.where(fresh, table.lows[chunks].astype(np.int64) + (1 << 15), 0), 2),
            column(np.where(fresh, packed_bits(table.bits[chunks]), 0), 2),
            column(np.where(fresh, table.strides[chunks], 0), 1),
        ]

    def _member_columns(self, ids: I64, of: NDArray[np.int32], counts: I64) -> list[bytes]:
        """Return the column of how many Gaussians of the chunk are left out before each one."""
        within = ids - self.contents.table.starts[of]
        before = np.concatenate([[-1], within[:-1]])
        before[np.cumsum(counts) - counts] = -1
        return [column(within - before - 1, 1)]

    def _skips(self, terms: I64, owners: I64) -> I64:
        """Return how many terms of the same Gaussian are left out before each term (M,)."""
        numbers = terms - self.contents.term_offsets[owners]
        before = np.concatenate([[-1], numbers[:-1]])[: len(terms)]
        apart = np.concatenate([[True], owners[1:] != owners[:-1]])[: len(terms)]
        return np.asarray(numbers - np.where(apart, -1, before) - 1)

    @cached_property
    def _owners(self) -> I64:
        """(T,) the Gaussian of each term."""
        return np.repeat(np.arange(len(self.contents)), self.contents.term_counts)

    @cached_property
    def _fields(self) -> NDArray[np.uint16]:
        """(N, 16) fields of all records, as the coder takes them."""
        return self.coding.split_records(self.contents)

    @cached_property
    def _chunks(self) -> Any:
        """Rows of chunks, as the coder takes them."""
        return chunks_of(self.contents.table)
