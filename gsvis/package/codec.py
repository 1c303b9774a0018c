"""Encode Gaussians as records of 16 bytes, and decode them. A record and the row of its chunk give one Gaussian.

A chunk is a run of up to 256 Gaussians with a box and a range of scales. Its row of the `ChunkTable` is sent once,
before the first of its records. A chunk ends before a Gaussian that is far away or of another size, because it would
make the records of the others coarse. Scene frame and units. This module knows no file.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.package._kernels import records as kernels
from gsvis.package.layout import RECORD_BYTES, RecordLayout
from gsvis.scene.gaussians import Gaussians

__all__ = ["CHUNK", "ChunkTable", "Geometry", "build_chunks", "chunk_starts", "decode_records", "encode_records"]

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]
I64 = NDArray[np.int64]

CHUNK = 256
"""Most Gaussians in a chunk."""

STEP = 1.0 / 16.0
"""Coarsest step of a coordinate, as a share of the largest standard deviation of a chunk's smallest Gaussian."""

SPREAD = 10 * 64
"""Most difference between the largest scales of two Gaussians of a chunk, in 1/64 octaves."""

_CUT_PLACES = (1 << 13) - 1  # from the layout with the fewest bits, so that chunks do not depend on the variant
_ROOTS = np.exp2(np.arange(64) / 64.0)


@dataclass(frozen=True, eq=False)
class ChunkTable:
    """The boxes and ranges of C chunks, read-only. Records are relative to them.

    Args:
        origins: (C, 3) float32, lowest corner of each chunk's box.
        steps: (C, 3) float32, >= 0; place p means origin + p * step, computed in float64.
        lows: (C,) int16, lowest log-scale in 1/64 octaves.
        strides: (C,) uint8, >= 1, steps of log-scales in 1/64 octaves.
        counts: (C,) uint16, Gaussians of each chunk, 1 to `CHUNK`.

    Raises:
        ValueError: If a shape, a length or a value is wrong.
    """

    origins: F32
    steps: F32
    lows: NDArray[np.int16]
    strides: U8
    counts: NDArray[np.uint16]

    def __post_init__(self) -> None:
        arrays = {
            "origins": _check.floats("origins", self.origins, ("C", 3)),
            "steps": _check.floats("steps", self.steps, ("C", 3)),
            "lows": _check.integers("lows", self.lows, ("C",), np.int16),
            "strides": _check.integers("strides", self.strides, ("C",), np.uint8),
            "counts": _check.integers("counts", self.counts, ("C",), np.uint16),
        }
        _check.same_length(**arrays)
        _check.in_range("steps", arrays["steps"], 0.0, np.inf)
        _check.in_range("strides", arrays["strides"], 1, 255)
        _check.in_range("counts", arrays["counts"], 1, CHUNK)
        for name, array in arrays.items():
            view = array.view()
            view.flags.writeable = False
            object.__setattr__(self, name, view)

    @classmethod
    def concatenate(cls, parts: list[ChunkTable]) -> ChunkTable:
        """Return one table with the rows of several; an empty list gives a table without rows."""
        if not parts:
            none = np.zeros((0, 3), np.float32)
            return cls(none, none, np.zeros(0, np.int16), np.zeros(0, np.uint8), np.zeros(0, np.uint16))
        names = ("origins", "steps", "lows", "strides", "counts")
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))

    def __len__(self) -> int:
        return len(self.counts)

    def __getitem__(self, rows: slice | NDArray[np.integer]) -> ChunkTable:
        """Return the rows at a slice or an index array."""
        return ChunkTable(self.origins[rows], self.steps[rows], self.lows[rows], self.strides[rows], self.counts[rows])

    @property
    def starts(self) -> I64:
        """(C + 1,) id of the first Gaussian of each chunk, and N."""
        return np.concatenate([np.zeros(1, np.int64), np.cumsum(self.counts, dtype=np.int64)])

    def of_all(self) -> NDArray[np.int32]:
        """Return (N,) int32, the chunk of every Gaussian."""
        return np.repeat(np.arange(len(self), dtype=np.int32), self.counts)


class Geometry(NamedTuple):
    """The decoded geometry of M records.

    Attributes:
        means: (M, 3) float32.
        quats: (M, 4) float32, unit, wxyz, w >= 0.
        scales: (M, 3) float32.
        opacities: (M,) float32.
    """

    means: F32
    quats: F32
    scales: F32
    opacities: F32


def chunk_starts(g: Gaussians, *, cuts: ArrayLike = (), finest: float = 0.0) -> I64:
    """Return (C,) int64, the first Gaussian of each chunk.

    Args:
        g: N Gaussians, in an order in which neighbors are near each other.
        cuts: Ascending ids before which a chunk always ends.
        finest: Least scale that positions are made for, scene units; smaller Gaussians are placed no more finely.

    Raises:
        ValueError: If `cuts` are not ascending or out of range.
    """
    n = len(g)
    bounds = np.concatenate([[0], _check.integers("cuts", np.asarray(cuts, np.int64), ("K",)), [n]])
    if (np.diff(bounds) < 0).any():
        raise ValueError(f"cuts: expected rising ids from 0 to {n}, got others")
    largest = kernels.log_scales(g.scales, np.empty((n, 3), np.int32))
    allowed = np.maximum(g.scales.max(axis=1, initial=0.0).astype(np.float64), finest) * STEP
    pieces = [np.zeros(0, np.int64)]
    for low, high in pairwise(bounds.tolist()):
        some, found = slice(low, high), np.empty(high - low, np.int64)
        means = g.means[some].astype(np.float64)
        count = kernels.chunk_starts(means, largest[some], allowed[some], _CUT_PLACES, CHUNK, SPREAD, found)
        pieces.append(low + found[:count])
    return np.concatenate(pieces)


def build_chunks(g: Gaussians, layout: RecordLayout, *, starts: ArrayLike | None = None) -> ChunkTable:
    """Build the table of the chunks of Gaussians.

    Args:
        g: N Gaussians.
        layout: Layout of the records.
        starts: (C,) the first Gaussian of each chunk, ascending from 0; None means `chunk_starts(g)`.

    Raises:
        ValueError: If the starts do not ascend from 0, or a chunk is larger than `CHUNK`.
    """
    n = len(g)
    heads = chunk_starts(g) if starts is None else _check.integers("starts", starts, ("C",))
    if n == 0:
        return ChunkTable.concatenate([])
    counts = np.diff(np.append(heads, n))
    if len(heads) == 0 or heads[0] != 0 or counts.min() < 1 or counts.max() > CHUNK:
        raise ValueError(f"starts: expected chunks of 1 to {CHUNK} Gaussians from 0 on, got others")
    levels = np.empty((n, 3), np.int32)
    kernels.log_scales(g.scales, levels)
    places = (1 << layout.position) - 1
    low, high = (np.asarray(of.reduceat(g.means, heads, axis=0), np.float64) for of in (np.minimum, np.maximum))
    steps = ((high - low) / places).astype(np.float32)
    short = steps.astype(np.float64) * places < high - low  # rounded down: the last step would not reach the end
    steps = np.where(short, np.nextafter(steps, np.float32(np.inf)), steps)
    lows = np.minimum.reduceat(levels.min(axis=1), heads)
    ranges = np.maximum.reduceat(levels.max(axis=1), heads) - lows
    strides = np.maximum(1, -(-ranges // ((1 << layout.scale) - 1)))
    return ChunkTable(low.astype(np.float32), steps, lows.astype(np.int16), strides.astype(np.uint8), counts)


def encode_records(
    g: Gaussians, colors: U8, table: ChunkTable, layout: RecordLayout, *, chunks: ArrayLike | None = None
) -> U8:
    """Return (N, 16) uint8, the records of Gaussians.

    Args:
        g: N Gaussians.
        colors: (N, 3) uint8 base colors as places in their tables, or (N, 4) with the scale of the color.
        table: Chunks that hold these Gaussians.
        layout: Layout of the records.
        chunks: (N,) row of each Gaussian's chunk; None means that the Gaussians fill the table, in order.

    Raises:
        ValueError: If lengths do not match, or a Gaussian lies outside its chunk.
    """
    rows = _rows(table, chunks, len(g))
    base = _check.integers("colors", colors, (len(g), 4 if layout.color_scale else 3), np.uint8)
    levels = np.empty((len(g), 3), np.int32)
    kernels.log_scales(g.scales, levels)
    places = (1 << layout.position) - 1
    away = g.means.astype(np.float64) - table.origins[rows]
    above = levels.min(axis=1, initial=1 << 20) - table.lows[rows]
    reach = ((1 << layout.scale) - 1) * table.strides[rows].astype(np.int32)
    over = levels.max(axis=1, initial=-(1 << 20)) - table.lows[rows] - reach
    if (away < 0).any() or (away > table.steps[rows].astype(np.float64) * places).any():
        raise ValueError("g: expected Gaussians within the boxes of their chunks, got one outside")
    if (above < 0).any() or (over > 0).any():
        raise ValueError("g: expected scales within the ranges of their chunks, got one outside")
    out = np.zeros((len(g), RECORD_BYTES), np.uint8)
    kernels.encode(
        rows, table.origins, table.steps, table.lows, table.strides, g.means, g.quats, levels, g.opacities, base,
        layout.bits, out,
    )  # fmt: skip
    return out


def decode_records(
    records: ArrayLike, table: ChunkTable, layout: RecordLayout, *, chunks: ArrayLike | None = None
) -> Geometry:
    """Return the geometry of records. Any bytes decode to Gaussians that can be drawn.

    Args:
        records: (M, 16) uint8.
        table: Rows of chunks.
        layout: Layout of the records.
        chunks: (M,) row of each record's chunk; None means that the records fill the table, in order.

    Raises:
        ValueError: If a shape does not match, or a row is out of range.
    """
    packed = _check.integers("records", records, ("M", RECORD_BYTES), np.uint8)
    m = len(packed)
    rows = _rows(table, chunks, m)
    found = Geometry(
        np.empty((m, 3), np.float32), np.empty((m, 4), np.float32), np.empty((m, 3), np.float32),
        np.empty(m, np.float32),
    )  # fmt: skip
    kernels.decode(
        rows, *_check.read_only(table.origins, table.steps, table.lows, table.strides, packed), layout.bits,
        layout.packed_from, _ROOTS, *found,
    )  # fmt: skip
    return found


def base_colors(records: U8, layout: RecordLayout) -> U8:
    """Return (M, 3 or 4) uint8, the base colors of records as places in their tables."""
    return np.ascontiguousarray(records[:, 1 : layout.packed_from])


def _rows(table: ChunkTable, chunks: ArrayLike | None, count: int) -> NDArray[np.int32]:
    if chunks is None:
        if int(table.counts.sum(dtype=np.int64)) != count:
            raise ValueError(f"table: expected chunks of {count:,} Gaussians, got {table.counts.sum():,}")
        return table.of_all()
    rows: NDArray[np.int32] = _check.integers("chunks", chunks, (count,), np.int32)
    _check.in_range("chunks", rows, 0, len(table) - 1)
    return rows
