"""What a package holds, in memory: records of Gaussians and terms, the table of chunks, levels; and what it stands for.

A record is bytes that travel as they are; `Contents.from_levels` makes them from a scene, and the other methods make a
scene of them. Ids are places in the order of the package. Scene frame and units.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.color.evaluate import evaluate_along
from gsvis.color.records import Grids, QuantizedColors, has_scales
from gsvis.package.codec import ChunkTable, base_colors, build_chunks, decode_records, encode_records
from gsvis.package.layout import RecordLayout, TermLayout
from gsvis.package.order import PackageOrder
from gsvis.package.terms import decode_terms, encode_terms
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.scene.sh import SH_C0

__all__ = ["Contents", "base_places", "base_rgb"]

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]
I64 = NDArray[np.int64]


@dataclass(frozen=True, eq=False, repr=False)
class Contents:
    """N Gaussians of all levels and their T terms, as records.

    Attributes:
        names: Of the levels, lowest first.
        table: Rows of the C chunks.
        chunk_levels: (C, 2) uint8 first and last level of the Gaussians of each chunk.
        records: (N, 16) uint8.
        term_counts: (N,) uint8 terms of each Gaussian.
        term_records: (T, B) uint8, Gaussian by Gaussian, in the order to be sent.
        grids: What base colors and terms point into.
        starts: (P + 1,) where parts begin.
    """

    names: tuple[str, ...]
    table: ChunkTable
    chunk_levels: U8
    records: U8
    term_counts: U8
    term_records: U8
    grids: Grids
    starts: I64

    @classmethod
    def from_levels(cls, levels: Levels, colors: QuantizedColors) -> Contents:
        """Records of levels in the order of a package.

        Args:
            levels: As `in_package_order` gives them.
            colors: Of their union, rounded with at most 8 bits for each part of the base color ("wire", "coarse").

        Raises:
            ValueError: If lengths or the order do not fit, a Gaussian has more than 255 terms, or packages do not hold
                the variant.
        """
        g = levels.union
        if len(colors) != len(g):
            raise ValueError(f"colors: expected those of {len(g):,} Gaussians, got {len(colors):,}")
        TermLayout.from_grids(colors.grids)
        order = PackageOrder.from_levels(levels)
        if not np.array_equal(order.permutation, np.arange(len(g))):
            raise ValueError("levels: expected the order of a package, got another; pass them through in_package_order")
        counts = np.diff(colors.offsets)
        _check.in_range("colors", counts, 0, 255)
        layout = RecordLayout.from_variant(colors.grids.variant)
        table = build_chunks(g, layout, starts=order.chunks)
        heads = table.starts[:-1]
        base = colors.base.astype(np.uint8)
        if layout.color_scale:
            base = np.concatenate([base, colors.scales.astype(np.uint8)[:, None]], axis=1)
        return cls(
            levels.names, table, np.stack([levels.first[heads], levels.last[heads]], axis=1),
            encode_records(g, base, table, layout), counts.astype(np.uint8), encode_terms(colors),
            colors.grids, order.starts,
        )  # fmt: skip

    def __len__(self) -> int:
        """N."""
        return len(self.records)

    def __repr__(self) -> str:
        return f"Contents({len(self):,} Gaussians, {len(self.term_records):,} terms, {len(self.table):,} chunks)"

    @property
    def layout(self) -> RecordLayout:
        """Where the bits of a record are."""
        return RecordLayout.from_variant(self.grids.variant)

    @cached_property
    def term_offsets(self) -> I64:
        """(N + 1,) the terms of Gaussian i are `term_offsets[i]:term_offsets[i + 1]`."""
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
        """What records stand for, in SH degree 0: base colors and no terms.

        Args:
            ids: (M,) which; None means all.
        """
        records, chunks = self.records, self.chunks
        if ids is not None:
            chosen = _check.integers("ids", ids, ("M",))
            _check.in_range("ids", chosen, 0, len(self) - 1)
            records, chunks = records[chosen], chunks[chosen]
        found = decode_records(records, self.table, self.layout, chunks=chunks)
        sh0 = ((base_rgb(records, self.grids).astype(np.float64) - 0.5) / SH_C0)[:, None]
        return Gaussians(*found, sh0)

    def levels(self) -> Levels:
        """All levels, decoded."""
        return Levels(self.gaussians(), self.first, self.last, self.names)

    def colors(self) -> QuantizedColors:
        """Base colors and all terms, as places in their tables."""
        n, base = len(self), base_colors(self.records, self.layout).astype(np.uint16)
        scales = base[:, 3] if self.layout.color_scale else np.zeros(0, np.uint16)
        terms = decode_terms(self.term_records, self.grids)
        axes = np.zeros((n, 0, 2), np.uint16)  # of variants that no package holds
        return QuantizedColors(self.grids, base[:, :3], scales, axes, self.term_offsets, *terms)


def base_places(records: U8, grids: Grids) -> U8:
    """Return the (M, 3 or 4) places of base colors in their tables; those past the end of a table are its last.

    Args:
        records: (M, 16).
        grids: The tables of the scene.
    """
    places, bits = base_colors(records, RecordLayout.from_variant(grids.variant)), grids.precision
    most = np.array([bits.base, bits.base, bits.base, bits.scale][: places.shape[1]])
    return places if most.min() >= 8 else np.minimum(places, ((1 << most) - 1).astype(np.uint8))


def base_rgb(records: U8, grids: Grids) -> F32:
    """(M, 3) RGB >= 0 that Gaussians show before any of their terms has come.

    Args:
        records: (M, 16).
        grids: The tables of the scene.
    """
    base = base_places(records, grids).astype(np.uint16)
    if not has_scales(grids.kind):
        return np.stack([np.maximum(grids.base_table(k), 0.0)[base[:, k]] for k in range(3)], axis=1)
    n, none = len(records), np.zeros(0, np.uint16)
    empty = none.reshape(0, grids.kind.intensities)
    offsets, axes = np.zeros(n + 1, np.int64), np.zeros((n, 0, 2), np.uint16)
    flat = QuantizedColors(
        grids, base[:, :3], base[:, 3], axes, offsets, none.astype(np.uint8), none.reshape(0, 2), none, empty
    )
    return np.ascontiguousarray(evaluate_along(flat.dequantize(), [[0.0, 0.0, 1.0]])[:, 0])
