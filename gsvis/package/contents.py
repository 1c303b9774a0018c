"""The contents of a package in memory: records of Gaussians and terms, the table of chunks, and levels.

Records are the bytes that are sent. `Contents.from_levels` encodes a scene; the other methods decode it. Ids are
places in the order of the package. Scene frame and units.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis._kernels.rounding import Limits
from gsvis.color.evaluate import evaluate_along
from gsvis.color.records import Grids, QuantizedColors, has_scales
from gsvis.package.codec import ChunkTable, base_colors, build_chunks, decode_records, encode_records
from gsvis.package.layout import RecordLayout, TermLayout
from gsvis.package.order import PackageOrder
from gsvis.package.terms import decode_terms, encode_terms
from gsvis.scene.facts import SceneFacts
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.scene.sh import SH_C0

__all__ = ["Contents", "base_places", "base_rgb"]

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]
I64 = NDArray[np.int64]


_NOTHING_KNOWN = SceneFacts()


@dataclass(frozen=True, eq=False, repr=False)
class Contents:
    """N Gaussians of all levels and their T terms, as records.

    Attributes:
        names: Names of the levels, lowest first.
        table: Rows of the C chunks.
        chunk_levels: (C, 2) uint8, first and last level of the Gaussians of each chunk.
        records: (N, 16) uint8, record of each Gaussian.
        term_counts: (N,) uint8, number of terms of each Gaussian.
        term_records: (T, B) uint8, record of each term, Gaussian by Gaussian, in the order in which they are sent.
        grids: The tables of base colors and terms.
        starts: (P + 1,) id of the first Gaussian of each part, and N.
        facts: Facts about the scene that are not in the records.
        limits: How the records are rounded; None for records that have all bits. See `gsvis.package.rounding`.
    """

    names: tuple[str, ...]
    table: ChunkTable
    chunk_levels: U8
    records: U8
    term_counts: U8
    term_records: U8
    grids: Grids
    starts: I64
    facts: SceneFacts = _NOTHING_KNOWN
    limits: Limits | None = None

    @classmethod
    def from_levels(cls, levels: Levels, colors: QuantizedColors, order: PackageOrder | None = None) -> Contents:
        """Return the records of levels.

        Args:
            levels: Levels in the order of a package, from `in_package_order`.
            colors: Colors of their union, rounded with at most 8 bits for each part of the base color ("wire",
                "coarse").
            order: The order of these levels, if it is known; None finds it.

        Raises:
            ValueError: If lengths do not match, the order is not that of a package, a Gaussian has more than 255 terms,
                or packages do not support the variant.
        """
        g = levels.union
        if len(colors) != len(g):
            raise ValueError(f"colors: expected those of {len(g):,} Gaussians, got {len(colors):,}")
        TermLayout.from_grids(colors.grids)
        order = order or PackageOrder.from_levels(levels)
        if not np.array_equal(order.permutation, np.arange(len(g))):
            k = int(np.argmax(order.permutation != np.arange(len(g))))
            got = f"Gaussian {k} in place of {order.permutation[k]}"
            raise ValueError(f"levels: expected the order of a package, got {got}; pass them through in_package_order")
        counts = np.diff(colors.offsets)
        _check.in_range("colors", counts, 0, 255)
        layout = RecordLayout.from_variant(colors.grids.variant)
        table = build_chunks(g, layout, starts=order.chunks, lattices=order.lattices)
        heads = table.starts[:-1]
        base = colors.base.astype(np.uint8)
        if layout.color_scale:
            base = np.concatenate([base, colors.scales.astype(np.uint8)[:, None]], axis=1)
        return cls(
            levels.names,
            table,
            np.stack([levels.first[heads], levels.last[heads]], axis=1),
            encode_records(g, base, table, layout),
            counts.astype(np.uint8),
            encode_terms(colors),
            colors.grids,
            order.starts,
            g.facts,
        )

    def __len__(self) -> int:
        """Return N, the number of Gaussians."""
        return len(self.records)

    def __repr__(self) -> str:
        return f"Contents({len(self):,} Gaussians, {len(self.term_records):,} terms, {len(self.table):,} chunks)"

    @property
    def layout(self) -> RecordLayout:
        """Layout of the records."""
        return RecordLayout.from_variant(self.grids.variant)

    @cached_property
    def term_offsets(self) -> I64:
        """(N + 1,) offsets: the terms of Gaussian i are `term_offsets[i]:term_offsets[i + 1]`."""
        return np.concatenate([np.zeros(1, np.int64), np.cumsum(self.term_counts, dtype=np.int64)])

    @cached_property
    def chunks(self) -> NDArray[np.int32]:
        """(N,) chunk of each Gaussian."""
        return self.table.of_all()

    @property
    def first(self) -> U8:
        """(N,) lowest level that has each Gaussian."""
        return np.asarray(self.chunk_levels[self.chunks, 0])

    @property
    def last(self) -> U8:
        """(N,) highest level that has each Gaussian."""
        return np.asarray(self.chunk_levels[self.chunks, 1])

    def gaussians(self, ids: ArrayLike | None = None) -> Gaussians:
        """Return decoded Gaussians with base colors only, as SH of degree 0.

        Args:
            ids: (M,) ids of the Gaussians; None means all.
        """
        records = self.records
        chunks = self.chunks
        if ids is not None:
            chosen = _check.integers("ids", ids, ("M",))
            _check.in_range("ids", chosen, 0, len(self) - 1)
            records = records[chosen]
            chunks = chunks[chosen]
        found = decode_records(records, self.table, self.layout, chunks=chunks)
        sh0 = ((base_rgb(records, self.grids).astype(np.float64) - 0.5) / SH_C0)[:, None]
        return Gaussians(*found, sh0, facts=self.facts)

    def levels(self) -> Levels:
        """Return all levels, decoded."""
        return Levels(self.gaussians(), self.first, self.last, self.names)

    def colors(self) -> QuantizedColors:
        """Return the base colors and all terms, as indices of their tables; an index past the end becomes the last."""
        base = base_places(self.records, self.grids).astype(np.uint16)
        scales = base[:, 3] if self.layout.color_scale else np.zeros(0, np.uint16)
        terms = decode_terms(self.term_records, self.grids)
        return QuantizedColors(self.grids, base[:, :3], scales, self.term_offsets, *terms)


def base_places(records: U8, grids: Grids) -> U8:
    """Return base colors as indices of their tables, (M, 3 or 4) uint8; an index past the end becomes the last.

    Args:
        records: (M, 16) uint8.
        grids: The tables of the scene.
    """
    places = base_colors(records, RecordLayout.from_variant(grids.variant))
    bits = grids.precision
    most = np.array([bits.base, bits.base, bits.base, bits.scale][: places.shape[1]])
    return places if most.min() >= 8 else np.minimum(places, ((1 << most) - 1).astype(np.uint8))


def base_rgb(records: U8, grids: Grids) -> F32:
    """Return the colors of Gaussians without their terms, (M, 3) float32 RGB >= 0.

    Args:
        records: (M, 16) uint8.
        grids: The tables of the scene.
    """
    base = base_places(records, grids).astype(np.uint16)
    if not has_scales(grids.kind):
        return np.stack([np.maximum(grids.base_table(k), 0.0)[base[:, k]] for k in range(3)], axis=1)
    n = len(records)
    none = np.zeros(0, np.uint16)
    empty = none.reshape(0, grids.kind.intensities)
    offsets = np.zeros(n + 1, np.int64)
    flat = QuantizedColors(
        grids, base[:, :3], base[:, 3], offsets, none.astype(np.uint8), none.reshape(0, 2), none, empty
    )
    return np.ascontiguousarray(evaluate_along(flat.dequantize(), [[0.0, 0.0, 1.0]])[:, 0])
