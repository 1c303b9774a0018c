"""Round records: the less light a Gaussian adds to an image, the fewer bits it keeps; docs/design/041 says why so.

Rounded records are records. Bits that they lack are zeros, and the coders of packages and of the wire leave them out,
because a reader knows from `Limits` which ones they are. Scene frame and units.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis._kernels.records import logarithms
from gsvis._kernels.rounding import Chunks, Limits
from gsvis.color.coarse import coarsen_terms
from gsvis.color.records import Grids, QuantizedColors
from gsvis.package._kernels import rounding as kernels
from gsvis.package.codec import ChunkTable, lay_linear
from gsvis.package.contents import Contents
from gsvis.package.layout import RecordLayout
from gsvis.package.order import PackageOrder
from gsvis.package.terms import encode_terms
from gsvis.scene.levels import Levels

__all__ = [
    "MOST_STEP",
    "Chunks",
    "Limits",
    "Quality",
    "chunks_of",
    "lights_of",
    "limits_for",
    "limits_of",
    "mean_light",
    "round_records",
    "round_terms",
    "rounded_contents",
    "sizes_of",
    "sizes_of_intensities",
]

I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]

MOST_LACKING = (4, 3, 3)
"""Most bits that centers, decays and intensities lack."""

MOST_STEP = 1 << 15
"""Largest size of a limit."""


@dataclass(frozen=True)
class Quality:
    """How records are rounded: the less light a Gaussian adds to an image, the coarser.

    The light of a Gaussian is the area of its outline times the square of its opacity.

    Attributes:
        place: log2 of the coarsest step of a coordinate, in mean scales, for an opaque Gaussian of median size. None
            keeps places as they are.
        turn: Bits dropped from each component of the quaternion, for a Gaussian of median area.
        opacity: Bits of the opacity that are rounded, for a Gaussian of median area.
        shape: Bits of the ratios of the scales that are rounded, for a Gaussian of mean light.
        color: Bits of each byte of the base color that are rounded, for a Gaussian of mean light.
        center: Bits of both angles of the center of a term, for a Gaussian of mean light and an intensity of 1.
        decay: Bits of the decay, for the same.
        intensity: Bits of each intensity, for a Gaussian of mean light.
    """

    place: float | None = -2.0
    turn: float = 4.75
    opacity: float = 2.75
    shape: float = 3.0
    color: float = 2.75
    center: float = 1.0
    decay: float = 0.5
    intensity: float = 2.5

    def finer(self, bits: float) -> Quality:
        """Return the quality with this many more bits of everything."""
        kept: dict[str, Any] = {name: None if value is None else value - bits for name, value in asdict(self).items()}
        return replace(self, **kept)


def chunks_of(table: ChunkTable) -> Chunks:
    """Return the rows of chunks in the form that kernels take."""
    bits = np.ascontiguousarray(np.abs(table.steps)).view(np.uint32).astype(np.int64)
    steps = (bits >> 23) - 127 + (bits & 0x7FFFFF > 0)
    curved = table.logarithmic
    wide = table.bits.astype(np.int64)
    ends = table.origins - table.steps.astype(np.float64) * ((np.int64(1) << wide) - 1)
    # log2 of the largest factor by which a logarithmic coordinate stretches a step
    reach = np.ceil(np.maximum(np.abs(table.origins), np.abs(ends)) * math.log2(math.e))
    steps[curved] += reach[curved].astype(np.int64)
    return Chunks(table.lows.astype(np.int64), table.strides.astype(np.int64), steps, wide)


def limits_of(contents: Contents, quality: Quality) -> Limits:
    """Return how the records of a scene are rounded.

    Args:
        contents: All records of the scene.
        quality: How to round.
    """
    sizes = sizes_of(contents)
    mean, area = np.median(sizes[:2], axis=1).tolist()
    return limits_for(quality, mean, area, mean_light(sizes[2]))


def sizes_of(contents: Contents) -> NDArray[np.float64]:
    """Return (3, N) sizes of Gaussians in octaves (log2); (3, 1) zeros if there are none.

    The rows are the mean scale, the area (product of the two larger scales), and the light (area times the square of
    the opacity in 255ths).
    """
    g = contents.gaussians()
    if not len(g):
        return np.zeros((3, 1))
    scales = np.log2(np.maximum(g.scales.astype(np.float64), 1e-30))
    areas = np.sort(scales, axis=1)[:, 1:].sum(axis=1)
    return np.stack([scales.mean(axis=1), areas, areas + 2.0 * np.log2(np.maximum(255.0 * g.opacities, 1.0))])


def mean_light(lights: NDArray[np.float64], counts: I64 | None = None) -> float:
    """Return the light, in octaves, whose square root is the mean of the square roots of all lights.

    After rounding by `Quality`, the error of a Gaussian is proportional to the square root of its light. So the sum of
    the errors is the same as that of equally many Gaussians of this light.

    Args:
        lights: (M,) the third row of `sizes_of`.
        counts: (M,) how often each light occurs; None means once.
    """
    most = float(lights.max())
    return most + 2.0 * float(np.log2(np.average(np.exp2((lights - most) / 2.0), weights=counts)))


def limits_for(quality: Quality, mean: float, area: float, light: float) -> Limits:
    """Return how a scene with these sizes is rounded.

    Args:
        quality: How to round.
        mean: Median of the mean scales, the first row of `sizes_of`.
        area: Median of the areas, the second row.
        light: `mean_light` of the lights, the third row.
    """
    limits = np.array(
        [
            -MOST_STEP if quality.place is None else quality.place + mean + np.log2(255),
            quality.turn + area / 4,
            quality.opacity + area / 4,
            quality.shape + light / 4,
            quality.color + light / 4,
            quality.center + light / 4,
            quality.decay + light / 4,
            quality.intensity + light / 4,
        ]
    )
    return Limits(*np.clip(np.rint(64 * limits), -MOST_STEP, MOST_STEP).astype(int).tolist())


def round_records(contents: Contents, limits: Limits, *, stated: bool = True) -> Contents:
    """Return rounded records of Gaussians, with zeros for the bits that they lack.

    Where places may lack bits, logarithmic chunks become linear boxes.

    Args:
        contents: The records of a package.
        limits: How they are rounded.
        stated: Whether the bits that a color lacks follow from the rounded record, as parts of a package need. On the
            wire nobody asks, and they follow from the record before.
    """
    laid = contents.records
    table = contents.table
    if limits.place > -MOST_STEP:
        laid, table = lay_linear(laid, table, contents.layout)
    out = np.empty((len(contents), 2), np.uint64)
    layout = contents.layout
    colors = layout.packed_from - 1
    logs = logarithms()[0]
    kernels.round_records(
        _words(laid), contents.chunks, chunks_of(table), layout.bits, colors, limits, logs, stated, out
    )
    records = out.view(np.uint8).reshape(-1, 16)
    return replace(contents, records=records, table=table, limits=limits)


def round_terms(contents: Contents, limits: Limits) -> Contents:
    """Return records whose terms lack bits.

    Args:
        contents: Rounded records.
        limits: How they are rounded.
    """
    if not len(contents.term_records):
        return contents
    colors = contents.colors()
    lights = lights_of(contents.records, contents.table, contents.layout, contents.chunks) >> 2
    sizes = sizes_of_intensities(contents.grids)[colors.intensities].max(axis=1)
    weights = np.repeat(lights, contents.term_counts) + sizes
    found = coarsen_terms(
        colors,
        np.clip((limits.center - weights) >> 6, 0, MOST_LACKING[0]),
        np.clip((limits.decay - weights) >> 6, 0, MOST_LACKING[1]),
        np.clip((limits.intensity - lights) >> 6, 0, MOST_LACKING[2]),
    )
    return replace(contents, term_records=encode_terms(found))


def rounded_contents(
    levels: Levels, colors: QuantizedColors, limits: Limits | None, order: PackageOrder | None = None
) -> Contents:
    """Return the records of levels, rounded unless `limits` is None.

    Args:
        levels: Levels in the order of a package, from `in_package_order`.
        colors: Colors of their union, rounded to tables.
        limits: How records are rounded.
        order: The order of these levels, if it is known; None finds it.

    Raises:
        ValueError: As `Contents.from_levels` does.
    """
    contents = Contents.from_levels(levels, colors, order)
    return contents if limits is None else round_terms(round_records(contents, limits), limits)


def lights_of(records: U8, table: ChunkTable, layout: RecordLayout, chunks: NDArray[np.int32]) -> I64:
    """Return the light (N,) of records (N, 16), whose chunks are the rows `chunks` (N,) of a table."""
    out = np.empty(len(records), np.int64)
    colors = layout.packed_from - 1
    kernels.lights(_words(records), chunks, chunks_of(table), layout.bits, colors, logarithms()[0], out)
    return out


def sizes_of_intensities(grids: Grids) -> I64:
    """Return (2^bits,) 64 log2 of the size of each intensity of a table, at least 2^-16."""
    table = np.abs(grids.intensity_table()).astype(np.float64)
    sizes = np.rint(64.0 * np.log2(np.maximum(table, 2.0**-16))).astype(np.int64)
    return np.append(sizes, sizes[-1])


def _words(records: U8) -> NDArray[np.uint64]:
    """Return records (N, 16) uint8 as (N, 2) uint64."""
    return np.ascontiguousarray(records).view("<u8").reshape(-1, 2)
