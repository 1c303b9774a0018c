"""Measure evidence for an up axis: level surface in thin slabs, upright surface around, and things on the ground.

Floors, ceilings, tables and ground are level and lie in few thin slabs below everything. Walls, trunks and legs are
upright and face all directions. Things stand on the ground, and nothing hangs below it. Lengths are in radii of the
core, so figures do not change if the scene is rotated, scaled or moved.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gsvis.scene._up_candidates import cross_frame
from gsvis.scene._up_sample import Sample

__all__ = ["AxisEvidence", "measure_axis"]

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

_LEVEL = np.cos(np.radians(10.0))
_SLOPED = np.cos(np.radians(15.0))
_UPRIGHT = np.sin(np.radians(10.0))
_LEANING = np.sin(np.radians(15.0))
_COLUMNS = 20  # columns along a side of the footprint
_FEWEST_IN_COLUMN = 5
_FLAT = 0.04  # height of a flat floor, in sides
_THIN = 0.05  # height of a slab, in sides
_BINS = 24  # of the half turn
_END = 0.05  # part of the height that is an end


@dataclass(frozen=True, kw_only=True)
class AxisEvidence:
    """Evidence found along an axis. If up and down differ, positive values mean that the axis points up.

    Args:
        level: Share of the surface within 10 degrees of level.
        upright: Share of the surface within 10 degrees of upright.
        around: How evenly upright surface faces all ways around, in (0, 1].
        other: Share of the upright surface that does not face the way that most of it faces.
        slab: Share of the surface that is level and in the two fullest thin slabs.
        pair: Surface of the second slab over that of the first, in [0, 1]: floor and ceiling.
        flat: Largest share of columns that begin, or end, at one height.
        height: Over the narrower side of the footprint.
        low: 1 if everything lies at the low end, -1 if at the high end.
        sided: How much more lies above the slabs than below, log odds.
        clutter: How much more stands low between the two slabs than hangs high, log odds; 0 without two.
        bright: Correlation of brightness with height between two slabs; 0 without two.
        base: How much wider the low end is than the high end, log ratio.
        contact: Opacity that stands right on the fullest slab, on its fuller side.
    """

    level: float
    upright: float
    around: float
    other: float
    slab: float
    pair: float
    flat: float
    height: float
    low: float
    sided: float
    clutter: float
    bright: float
    base: float
    contact: float


class _Slabs(NamedTuple):
    """The two fullest slabs of level surface along an axis: centers, shares, and how thick a slab is."""

    first: float
    second: float
    most: float
    less: float
    thickness: float


def measure_axis(sample: Sample, axis: F64) -> AxisEvidence:
    """Measure the evidence along an axis.

    Args:
        sample: The surface of the core.
        axis: (3,) unit vector.
    """
    along = np.abs(sample.normals @ axis)
    heights = sample.places @ axis
    across = sample.places @ np.stack(cross_frame(axis), axis=1)
    narrow, wide = _extents(across, sample.mixed)
    low, middle, high = _quantiles(heights, sample.mixed, (0.02, 0.5, 0.98))
    height = max(float(high - low), 1e-9)
    side = max(float(np.sqrt(narrow * wide)), 1e-9)
    slabs = _find_slabs(heights, along, sample.surface, _THIN * min(side, max(height, 0.3 * side)), height)
    ring = along < _LEANING
    around, other = _spread(sample.normals[ring] @ np.stack(cross_frame(axis), axis=1), sample.surface[ring])
    pair = slabs.less / slabs.most if slabs.most > 0.0 else 0.0
    return AxisEvidence(
        level=float(sample.surface[along > _LEVEL].sum()),
        upright=float(sample.surface[along < _UPRIGHT].sum()),
        around=around,
        other=other,
        slab=slabs.most + slabs.less,
        pair=pair,
        flat=_flatness(heights, across),
        height=height / max(narrow, 1e-9),
        low=1.0 - 2.0 * float(middle - low) / height,
        sided=_sidedness(heights, sample.mixed, slabs),
        clutter=pair * _clutter(heights, along, sample.detail, slabs),
        bright=pair * _correlation(sample.luminance, heights),
        base=_base(heights, across),
        contact=_contact(heights, along, sample.detail, slabs, 0.1 * narrow),
    )


def _quantiles(values: F64, weights: F64, shares: tuple[float, ...]) -> F64:
    """Return the weighted quantiles of values."""
    order = np.argsort(values, kind="stable")
    return np.asarray(np.interp(shares, np.cumsum(weights[order]) / weights.sum(), values[order]))


def _extents(across: F64, weights: F64) -> tuple[float, float]:
    """Return the narrower and the wider extent of a footprint (M, 2), along its principal axes."""
    axes = np.linalg.eigh(np.cov(across.T, aweights=weights))[1]
    spans = [float(np.subtract(*_quantiles(across @ axis, weights, (0.98, 0.02)))) for axis in axes.T]
    return min(spans), max(spans)


def _spread(flat: F64, weights: F64) -> tuple[float, float]:
    """Return how evenly directions (R, 2) without signs are spread, at most 1, and their share off the fullest."""
    if not weights.sum() > 0.0:
        return 0.01, 0.0
    turns = np.arctan2(flat[:, 1], flat[:, 0]) / np.pi % 1.0
    evenness = 0.0
    fullest = 0.0
    for shift in (0.0, 0.5):
        bins = (turns * _BINS + shift).astype(np.int64) % _BINS
        share = np.bincount(bins, weights=weights, minlength=_BINS) / weights.sum()
        evenness += 0.5 * float(np.exp(-np.sum(share * np.log(share + 1e-12)))) / _BINS
        fullest = max(fullest, float((share + np.roll(share, 1) + np.roll(share, -1)).max()))
    return evenness, 1.0 - fullest


def _find_slabs(heights: F64, along: F64, surface: F64, thickness: float, height: float) -> _Slabs:
    """Return the fullest slab of level surface, and the fullest slab that is well apart from it."""
    level = np.flatnonzero(along > _SLOPED)
    if len(level) == 0:
        return _Slabs(0.0, 0.0, 0.0, 0.0, thickness)
    level = level[np.argsort(heights[level], kind="stable")]
    bottoms = heights[level]
    filled = np.append(0.0, np.cumsum(surface[level]))
    shares = filled[np.searchsorted(bottoms, bottoms + thickness, "right")] - filled[:-1]
    first = int(shares.argmax())
    apart = np.where(np.abs(bottoms - bottoms[first]) > max(0.25 * height, 2.0 * thickness), shares, 0.0)
    second = int(apart.argmax())
    centers = bottoms + 0.5 * thickness
    return _Slabs(float(centers[first]), float(centers[second]), shares[first], apart[second], thickness)


def _sidedness(heights: F64, weights: F64, slabs: _Slabs) -> float:
    """Return the log odds of lying above the slabs, averaged over both, close to them and farther off."""

    def odds(center: float) -> float:
        """Return the log odds of lying above a height, close to it and farther off."""
        found = []
        for gap in (slabs.thickness, 3.0 * slabs.thickness):
            above, below = (float(weights[sign * (heights - center) > gap].sum()) for sign in (1.0, -1.0))
            found.append(np.clip(np.log((above + 0.02) / (below + 0.02)), -2.5, 2.5))
        return float(np.mean(found))

    total = slabs.most + slabs.less
    return (slabs.most * odds(slabs.first) + slabs.less * odds(slabs.second)) / total if total > 0.0 else 0.0


def _clutter(heights: F64, along: F64, detail: F64, slabs: _Slabs) -> float:
    """Return the log odds that surface between two slabs, if not upright, lies in the lower half."""
    low, high = sorted((slabs.first, slabs.second))
    between = (heights > low + slabs.thickness) & (heights < high - slabs.thickness)
    lower = heights < 0.5 * (low + high)
    found = 0.0
    for chosen in (along > np.sin(np.radians(20.0)), along > np.cos(np.radians(20.0))):
        inside = between & chosen
        found += float(np.log((detail[inside & lower].sum() + 0.005) / (detail[inside & ~lower].sum() + 0.005)))
    return 0.5 * found


def _contact(heights: F64, along: F64, detail: F64, slabs: _Slabs, reach: float) -> float:
    """Return the opacity within reach of the fullest slab that is not part of it."""
    found = 0.0
    for sign in (1.0, -1.0):
        off = sign * (heights - slabs.first) - slabs.thickness
        found = max(found, float(detail[(off > 0.0) & (off < reach) & (along < _SLOPED)].sum()))
    return found


def _correlation(values: F64, heights: F64) -> float:
    """Return the correlation of two arrays (M,); 0 if one is constant."""
    deviations = values - values.mean(), heights - heights.mean()
    norm = float(np.linalg.norm(deviations[0]) * np.linalg.norm(deviations[1]))
    return float(deviations[0] @ deviations[1]) / norm if norm > 1e-9 * len(values) else 0.0


def _base(heights: F64, across: F64) -> float:
    """Return the log ratio of the widths of the low and the high end: standing things are wider at the base."""
    low, high = np.quantile(heights, [0.002, 0.998])
    reach = _END * (high - low)
    widths = []
    for end in (heights < low + reach, heights > high - reach):
        count = int(np.count_nonzero(end))
        widths.append(max(float(np.linalg.det(np.cov(across[end].T))), 0.0) ** 0.25 if count > 5 else 0.0)
    return float(np.clip(np.log((widths[0] + 0.01) / (widths[1] + 0.01)), -2.0, 2.0))


def _flatness(heights: F64, across: F64) -> float:
    """Return the largest share of the columns over the footprint that begin, or end, at one height.

    The columns cover the box around the footprint (M, 2), because ground extends under all of it.
    """
    across = across @ np.linalg.eigh(np.cov(across.T))[1]
    low, high = np.quantile(across, [0.02, 0.98], axis=0)
    side = float(np.sqrt(np.prod(high - low))) / _COLUMNS
    if not side > 0.0:
        return 0.0
    counts = np.minimum(np.ceil((high - low) / side), 10 * _COLUMNS).astype(np.int64)
    cells = np.floor((across - low) / side).astype(np.int64)
    inside = np.flatnonzero(((cells >= 0) & (cells < counts)).all(axis=1))
    column = cells[inside, 0] * counts[1] + cells[inside, 1]
    height = heights[inside]
    order = np.lexsort((height, column))
    column = column[order]
    height = height[order]
    starts = np.flatnonzero(np.append(True, column[1:] != column[:-1]))
    sizes = np.diff(np.append(starts, len(column)))
    full = sizes >= _FEWEST_IN_COLUMN
    if not full.any():
        return 0.0
    ends = (height[starts[full] + (share * sizes[full]).astype(np.int64)] for share in (0.05, 0.95))
    covered = np.count_nonzero(full) / min(float(counts.prod()), len(heights) / _FEWEST_IN_COLUMN)
    return min(1.0, covered) * max(_fullest(np.sort(each), _FLAT * side * _COLUMNS) for each in ends)


def _fullest(values: F64, width: float) -> float:
    """Return the largest share of sorted values in a window."""
    return float((np.searchsorted(values, values + width, "right") - np.arange(len(values))).max()) / len(values)
