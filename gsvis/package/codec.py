"""Encode Gaussians as records of 16 bytes, and decode them. A record and the row of its chunk give one Gaussian.

A chunk is a run of up to 256 Gaussians with a box and a range of scales. Its row of the `ChunkTable` is sent once,
before the first of its records. A chunk ends before a Gaussian that is far away or much larger or smaller, because that
one would make all records of the chunk coarse. Centers on the lattice of a SOG file are kept exactly: their chunk uses
the steps of the lattice. Scene frame and units. This module does not read or write files.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.package._kernels import records as kernels
from gsvis.package.lattice import Lattices
from gsvis.package.layout import RECORD_BYTES, RecordLayout
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.symlog import symlog

__all__ = [
    "CHUNK",
    "ChunkTable",
    "Geometry",
    "build_chunks",
    "chunk_starts",
    "decode_records",
    "encode_records",
    "lay_linear",
    "packed_bits",
    "unpack_bits",
]

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
_MOST_BITS = 14  # most bits of a place on an axis
_ON_LATTICE = (1 << _MOST_BITS) - 1  # most places of a chunk on a lattice; a layout with fewer bits stays linear
# Chunks on a lattice are used if they are at most twice as many as without it, plus one for 8 Gaussians.
_MORE = 2.0
_ALONE = 8
_MOST_SYMLOG = 88.0  # largest symmetric logarithm in a logarithmic chunk; the largest float32 has 88.7
_ROOTS = np.exp2(np.arange(64) / 64.0)


@dataclass(frozen=True, eq=False)
class ChunkTable:
    """The boxes and ranges of C chunks, read-only. Records are relative to them.

    Args:
        origins: (C, 3) float32, lowest corner of each chunk's box.
        steps: (C, 3) float32. Where all three are >= 0, place p means the coordinate origin + p * step, computed in
            float64. Where all three are < 0, the chunk is logarithmic: origin - p * step is the symmetric logarithm u
            of the coordinate, and sign(u) (exp(|u|) - 1) is the coordinate.
        lows: (C,) int16, lowest log-scale in 1/64 octaves.
        strides: (C,) uint8, >= 1, steps of log-scales in 1/64 octaves.
        counts: (C,) uint16, Gaussians of each chunk, 1 to `CHUNK`.
        bits: (C, 3) uint8, bits of a place on each axis, 0 to 14.

    Raises:
        ValueError: If a shape, a length or a value is wrong.
    """

    origins: F32
    steps: F32
    lows: NDArray[np.int16]
    strides: U8
    counts: NDArray[np.uint16]
    bits: U8

    def __post_init__(self) -> None:
        arrays = {
            "origins": _check.floats("origins", self.origins, ("C", 3)),
            "steps": _check.floats("steps", self.steps, ("C", 3)),
            "lows": _check.integers("lows", self.lows, ("C",), np.int16),
            "strides": _check.integers("strides", self.strides, ("C",), np.uint8),
            "counts": _check.integers("counts", self.counts, ("C",), np.uint16),
            "bits": _check.integers("bits", self.bits, ("C", 3), np.uint8),
        }
        _check.same_length(**arrays)
        _check.in_range("bits", arrays["bits"], 0, _MOST_BITS)
        _check_steps(arrays["origins"], arrays["steps"], arrays["bits"])
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
            low = np.zeros(0, np.int16)
            stride = np.zeros(0, np.uint8)
            count = np.zeros(0, np.uint16)
            return cls(none, none, low, stride, count, np.zeros((0, 3), np.uint8))
        names = ("origins", "steps", "lows", "strides", "counts", "bits")
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))

    def __len__(self) -> int:
        return len(self.counts)

    def __getitem__(self, rows: slice | NDArray[np.integer]) -> ChunkTable:
        """Return the rows at a slice or an index array."""
        origins = self.origins[rows]
        steps = self.steps[rows]
        lows = self.lows[rows]
        strides = self.strides[rows]
        return ChunkTable(origins, steps, lows, strides, self.counts[rows], self.bits[rows])

    @property
    def logarithmic(self) -> NDArray[np.bool_]:
        """(C,) whether each chunk is logarithmic."""
        return np.asarray(self.steps[:, 0] < 0.0)

    @property
    def starts(self) -> I64:
        """(C + 1,) id of the first Gaussian of each chunk, and N."""
        return np.concatenate([np.zeros(1, np.int64), np.cumsum(self.counts, dtype=np.int64)])

    def of_all(self) -> NDArray[np.int32]:
        """Return the chunk (N,) of every Gaussian, int32."""
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


def chunk_starts(g: Gaussians, *, cuts: ArrayLike = (), finest: float = 0.0, lattices: Lattices | None = None) -> I64:
    """Divide Gaussians into chunks; return the first Gaussian of each chunk, (C,) int64.

    Args:
        g: N Gaussians, in an order in which neighbors are near each other.
        cuts: Ascending ids before which a chunk always ends.
        finest: Smallest scale that decides how fine positions are, scene units; below it they do not become finer.
        lattices: Lattices that the centers lie on; a chunk has centers of one lattice only.

    Raises:
        ValueError: If `cuts` are not ascending or out of range.
    """
    n = len(g)
    bounds = np.concatenate([[0], _check.integers("cuts", np.asarray(cuts, np.int64), ("K",)), [n]])
    if (np.diff(bounds) < 0).any():
        raise ValueError(f"cuts: expected rising ids from 0 to {n}, got {_check.not_rising(bounds)}")
    if lattices is not None:
        bounds = np.sort(np.concatenate([bounds, 1 + np.flatnonzero(np.diff(lattices.of))]))
    largest = kernels.log_scales(g.scales, np.empty((n, 3), np.int32))
    allowed = np.maximum(g.scales.max(axis=1, initial=0.0).astype(np.float64), finest) * STEP
    pieces = [np.zeros(0, np.int64)]
    for low, high in pairwise(bounds.tolist()):
        some = slice(low, high)
        found = _starts_of(g.means[some].astype(np.float64), largest[some], allowed[some], _CUT_PLACES)
        if lattices is not None and high > low and lattices.of[low] >= 0:
            places = lattices.places[some].astype(np.float64)
            exact = _starts_of(places, largest[some], np.ones(high - low), _ON_LATTICE)
            found = exact if len(exact) <= _MORE * len(found) + 1 + (high - low) // _ALONE else found
        pieces.append(low + found)
    return np.concatenate(pieces)


def _starts_of(places: NDArray[np.float64], largest: NDArray[np.int32], steps: NDArray[np.float64], most: int) -> I64:
    """Return the first Gaussian of each chunk; arguments as for the kernel `chunk_starts`, with `most` steps a side."""
    found = np.empty(len(places), np.int64)
    return found[: kernels.chunk_starts(places, largest, steps, most, CHUNK, SPREAD, found)]


def build_chunks(
    g: Gaussians, layout: RecordLayout, *, starts: ArrayLike | None = None, lattices: Lattices | None = None
) -> ChunkTable:
    """Build the table of the chunks of Gaussians.

    Args:
        g: N Gaussians.
        layout: Layout of the records.
        starts: (C,) the first Gaussian of each chunk, ascending from 0; None means `chunk_starts(g)`.
        lattices: Lattices that the centers lie on. A chunk on a lattice is logarithmic if the bits suffice.

    Raises:
        ValueError: If the starts do not ascend from 0, or a chunk is larger than `CHUNK`.
    """
    n = len(g)
    heads = chunk_starts(g) if starts is None else _check.integers("starts", starts, ("C",))
    if n == 0:
        return ChunkTable.concatenate([])
    counts = np.diff(np.append(heads, n))
    if len(heads) == 0 or heads[0] != 0:
        got = f"{heads[0]} at index 0" if len(heads) else "none"
        raise ValueError(f"starts: expected chunks from 0 on, got {got}")
    if counts.min() < 1 or counts.max() > CHUNK:
        got = f"{counts.min()} to {counts.max()}"
        raise ValueError(f"starts: expected chunks of 1 to {CHUNK} Gaussians, got {got}")
    levels = np.empty((n, 3), np.int32)
    kernels.log_scales(g.scales, levels)
    places = (1 << layout.position) - 1
    origins, steps = _boxes(g.means, heads, places)
    lows = np.minimum.reduceat(levels.min(axis=1), heads)
    ranges = np.maximum.reduceat(levels.max(axis=1), heads) - lows
    strides = np.maximum(1, -(-ranges // ((1 << layout.scale) - 1)))
    bits = np.full((len(heads), 3), layout.position, np.uint8)
    if lattices is not None:
        _use_lattices(lattices, heads, places, origins, steps, bits)
    return ChunkTable(origins, steps, lows.astype(np.int16), strides.astype(np.uint8), counts, bits)


def _boxes(means: F32, heads: I64, places: int) -> tuple[F32, F32]:
    """Return origins and steps (C, 3) of the boxes around chunks, with `places` steps along each side."""
    low = np.minimum.reduceat(means, heads, axis=0).astype(np.float64)
    high = np.maximum.reduceat(means, heads, axis=0).astype(np.float64)
    steps = ((high - low) / places).astype(np.float32)
    short = steps.astype(np.float64) * places < high - low  # rounded down: the last place would not reach the end
    return low.astype(np.float32), np.where(short, np.nextafter(steps, np.float32(np.inf)), steps)


def _use_lattices(lattices: Lattices, heads: I64, most: int, origins: F32, steps: F32, bits: U8) -> None:
    """Make chunks logarithmic that lie on one lattice, need places up to `most` only, and are not too far away.

    Args:
        lattices: The lattices.
        heads: (C,) first Gaussian of each chunk.
        most: Highest place on an axis.
        origins: (C, 3) origins of the chunks; changed.
        steps: (C, 3) steps of the chunks; changed.
        bits: (C, 3) bits of places; changed.
    """
    low = np.minimum.reduceat(lattices.places, heads, axis=0)
    high = np.maximum.reduceat(lattices.places, heads, axis=0)
    least = np.minimum.reduceat(lattices.of, heads)
    last = np.maximum.reduceat(lattices.of, heads)
    rows = np.flatnonzero((least >= 0) & (least == last) & (high - low <= most).all(axis=1))
    wide = np.frexp((high[rows] - low[rows]).astype(np.float64))[1]  # bit length
    step = lattices.steps[least[rows]]
    origin = lattices.offsets[least[rows]] + low[rows] * step
    near = (np.maximum(np.abs(origin), np.abs(origin + (1 << wide) * step)) < _MOST_SYMLOG).all(axis=1)
    rows = rows[near]
    origins[rows] = origin[near]
    steps[rows] = -step[near]
    bits[rows] = wide[near]


def encode_records(
    g: Gaussians, colors: U8, table: ChunkTable, layout: RecordLayout, *, chunks: ArrayLike | None = None
) -> U8:
    """Encode Gaussians as records, (N, 16) uint8.

    Args:
        g: N Gaussians.
        colors: (N, 3) uint8 base colors as places in their tables, or (N, 4) with the scale of the color.
        table: Chunks that hold these Gaussians.
        layout: Layout of the records.
        chunks: (N,) row of each Gaussian's chunk; None means that the Gaussians fill the table, in order.

    Raises:
        ValueError: If lengths do not match, or a Gaussian lies outside its chunk.
    """
    rows = _rows_of_records(table, chunks, len(g))
    base = _check.integers("colors", colors, (len(g), 4 if layout.color_scale else 3), np.uint8)
    levels = np.empty((len(g), 3), np.int32)
    kernels.log_scales(g.scales, levels)
    places = _places_in_chunks(g.means, table, rows, layout)
    above = levels.min(axis=1, initial=1 << 20) - table.lows[rows]
    reach = ((1 << layout.scale) - 1) * table.strides[rows].astype(np.int32)
    over = levels.max(axis=1, initial=-(1 << 20)) - table.lows[rows] - reach
    if (above < 0).any() or (over > 0).any():
        k = int(np.argmax((above < 0) | (over > 0)))
        raise ValueError(f"g: expected scales within the ranges of their chunks, got {g.scales[k]} at index {k}")
    out = np.zeros((len(g), RECORD_BYTES), np.uint8)
    kernels.encode(rows, places, table.lows, table.strides, g.quats, levels, g.opacities, base, layout.bits, out)
    return out


def _places_in_chunks(
    centers: F32, table: ChunkTable, rows: NDArray[np.int32], layout: RecordLayout
) -> NDArray[np.int32]:
    """Return the places (N, 3) of centers (N, 3) in their chunks.

    Raises:
        ValueError: If a center is outside of its chunk.
    """
    curved = table.logarithmic[rows]
    steps = np.abs(table.steps[rows].astype(np.float64))
    means = centers.astype(np.float64)
    means[curved] = symlog(means[curved])
    away = means - table.origins[rows]
    along = np.rint(np.divide(away, steps, out=np.zeros_like(away), where=steps > 0.0))
    most = (np.int64(1) << table.bits[rows].astype(np.int64)) - 1
    straight = ~curved[:, None]
    outside = np.where(straight, (away < 0) | (away > steps * most), (along < 0) | (along > most))
    if table.bits.max(initial=0) > layout.position:
        raise ValueError(f"table: expected places of at most {layout.position} bits, got {table.bits.max()}")
    if outside.any():
        k = int(np.argmax(outside.any(axis=1)))
        raise ValueError(f"g: expected centers within the boxes of their chunks, got {centers[k]} at index {k}")
    return np.asarray(np.minimum(along, most), np.int32)


def decode_records(
    records: ArrayLike, table: ChunkTable, layout: RecordLayout, *, chunks: ArrayLike | None = None
) -> Geometry:
    """Decode the geometry of records. Any bytes decode to Gaussians that can be drawn.

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
    rows = _rows_of_records(table, chunks, m)
    found = Geometry(
        np.empty((m, 3), np.float32),
        np.empty((m, 4), np.float32),
        np.empty((m, 3), np.float32),
        np.empty(m, np.float32),
    )
    kernels.decode(
        rows,
        *_check.read_only(table.origins, table.steps, table.lows, table.strides, packed),
        layout.bits,
        layout.packed_from,
        _ROOTS,
        *found,
    )
    return found


def lay_linear(records: U8, table: ChunkTable, layout: RecordLayout) -> tuple[U8, ChunkTable]:
    """Return records and chunks with linear places in all bits of the layout; only centers change.

    Args:
        records: (N, 16) uint8, which fill the table in order.
        table: Rows of the chunks.
        layout: Layout of the records.
    """
    heads = np.flatnonzero(table.logarithmic)
    if not len(heads):
        return records, table
    rows = table.of_all()
    some = np.flatnonzero(table.logarithmic[rows])
    means = decode_records(records[some], table, layout, chunks=rows[some]).means
    origins = table.origins.copy()
    steps = table.steps.copy()
    bits = table.bits.copy()
    counts = table.counts[heads].astype(np.int64)
    origins[heads], steps[heads] = _boxes(means, np.cumsum(counts) - counts, (1 << layout.position) - 1)
    bits[heads] = layout.position
    laid = ChunkTable(origins, steps, table.lows, table.strides, table.counts, bits)
    out = records.copy()
    places = _places_in_chunks(means, laid, rows[some], layout)
    kernels.put_places(out.view("<u8").reshape(-1, 2), some, places, layout.bits, layout.packed_from)
    return out, laid


def packed_bits(bits: U8) -> NDArray[np.uint16]:
    """Pack the bits (C, 3) of places on x, y and z into (C,) uint16, four bits each, x lowest."""
    return np.asarray(bits.astype(np.uint16) @ np.array([1, 16, 256], np.uint16), np.uint16)


def unpack_bits(packed: ArrayLike, most: int) -> U8:
    """Return the bits (C, 3) that `packed_bits` packed.

    Args:
        packed: (C,) uint16.
        most: Most bits of a place.

    Raises:
        ValueError: If a place has more bits, or a bit above the three fields is set.
    """
    words = np.asarray(packed, np.uint16)
    _check.in_range("bits", words, 0, 0xFFF)
    bits = np.stack([words & 15, words >> 4 & 15, words >> 8], axis=1).astype(np.uint8)
    _check.in_range("bits", bits, 0, most)
    return bits


def _check_steps(origins: F32, steps: F32, bits: U8) -> None:
    """Raise ValueError unless each chunk is linear, or logarithmic with coordinates that fit float32."""
    curved = (steps < 0.0).any(axis=1)
    ends = origins.astype(np.float64) - steps.astype(np.float64) * ((np.int64(1) << bits.astype(np.int64)) - 1)
    reach = np.maximum(np.abs(origins), np.abs(ends)).max(axis=1, initial=0.0)
    wrong = curved & ((steps >= 0.0).any(axis=1) | (reach > _MOST_SYMLOG))
    if wrong.any():
        row = int(np.argmax(wrong))
        expected = f"all >= 0, or all < 0 and logarithms up to {_MOST_SYMLOG:g}"
        raise ValueError(f"steps: expected {expected}, got {steps[row]}")


def base_colors(records: U8, layout: RecordLayout) -> U8:
    """Return (M, 3 or 4) uint8, the base colors of records as places in their tables."""
    return np.ascontiguousarray(records[:, 1 : layout.packed_from])


def _rows_of_records(table: ChunkTable, chunks: ArrayLike | None, count: int) -> NDArray[np.int32]:
    """Return the row (M,) of the chunk of each of `count` records; see `decode_records`."""
    if chunks is None:
        if int(table.counts.sum(dtype=np.int64)) != count:
            raise ValueError(f"table: expected chunks of {count:,} Gaussians, got {table.counts.sum():,}")
        return table.of_all()
    rows: NDArray[np.int32] = _check.integers("chunks", chunks, (count,), np.int32)
    _check.in_range("chunks", rows, 0, len(table) - 1)
    return rows
