"""Find directions that could be up: peaks of the surface's normals, and the principal axes of normals and places.

Directions are unit vectors without a sign. They rotate with the scene, because no fixed grid of directions is used.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsvis.scene._up_sample import Sample

__all__ = ["cross_frame", "find_candidates", "find_plumb", "settle"]

F64 = NDArray[np.float64]

_SAMPLED = 2500  # normals whose density is compared
_BLOCK = 500
_WIDTHS = (6.0, 6.0, 3.0, 3.0, 3.0)  # degrees of the kernel, narrower with every step
_PEAKS = 8
_APART = 20.0  # degrees between peaks
_DIFFERENT = 4.0  # degrees between candidates
_LEAST_NEAR = 1e-9  # share of the surface near a plane, below which rounding would decide
_SLABS = (0.15, 0.08, 0.05, 0.04)  # standard deviations of heights about a plane, over the footprint's side
_TOLERANCES = (12.0, 8.0, 6.0, 5.0)  # degrees within which surface counts as level or upright
_LEANS = (18.0, 14.0, 10.0, 7.0, 5.0, 4.0, 4.0)  # degrees within which steep surface counts as plumb
_STEEP = np.cos(np.radians(45.0))
_FARTHEST = np.cos(np.radians(30.0))
_TWO_WAYS = 0.08  # least mean square across the second way that plumb surface faces
_CLEARER = 1.7  # times as much plumb surface as along the normal of the ground
_ENOUGH = 0.2  # of the steep surface


def find_candidates(sample: Sample) -> F64:
    """Return (K, 3) directions that could be the up axis, K from 3 to about 17.

    Args:
        sample: The surface of the core.
    """
    about = sample.places - sample.mixed @ sample.places
    tensors = (
        (sample.normals.T * sample.surface) @ sample.normals,
        (about.T * sample.mixed) @ about,
    )
    principal = [axis for tensor in tensors for axis in np.linalg.eigh(tensor)[1].T]
    planes = [_fit_plane(sample, axis) for axis in principal[3:]]
    kept: list[F64] = []
    for direction in (*_peaks(sample), *planes, *(settle(sample, axis) for axis in principal)):
        if all(abs(direction @ other) < np.cos(np.radians(_DIFFERENT)) for other in kept):
            kept.append(direction)
    return np.array(kept)


def settle(sample: Sample, axis: F64) -> F64:
    """Return the direction near an axis that best fits level and upright surface.

    Args:
        sample: The surface of the core.
        axis: (3,) unit vector to start from.
    """
    found = axis
    for tolerance in _TOLERANCES:
        sine = np.sin(np.radians(tolerance))
        along = sample.normals @ found
        level = np.maximum(1.0 - (1.0 - along**2) / sine**2, 0.0) * sample.surface
        upright = np.maximum(1.0 - along**2 / sine**2, 0.0) * sample.surface
        tensor = (sample.normals.T * (level - upright)) @ sample.normals
        best = np.linalg.eigh(tensor)[1][:, 2]
        best = best if best @ found >= 0.0 else -best
        if best @ axis < np.cos(np.radians(2.0 * _TOLERANCES[0])):
            return axis
        found = best
    return np.asarray(found)


def find_plumb(sample: Sample, up: F64) -> F64:
    """Return the direction of walls and trunks if they clearly lean from the normal of the ground; else that normal.

    Ground can slope, but walls and trunks on it stand vertically.

    Args:
        sample: The surface of the core.
        up: (3,) unit vector, the normal of the ground.
    """
    steep = np.flatnonzero(np.abs(sample.normals @ up) < _STEEP)
    normals = sample.normals[steep]
    weights = (sample.standing)[steep]
    found = up
    for tolerance in _LEANS:
        near = np.exp(-0.5 * ((normals @ found) / np.sin(np.radians(tolerance))) ** 2) * weights
        if not near.sum() > 0.0:
            return up
        sizes, axes = np.linalg.eigh((normals.T * near) @ normals / near.sum())
        found = axes[:, 0] if axes[:, 0] @ up >= 0.0 else -axes[:, 0]
        if sizes[1] < _TWO_WAYS or found @ up < _FARTHEST:
            return up
    sharp = np.sin(np.radians(_LEANS[-1]))
    plumb, level = (float(weights[np.abs(normals @ axis) < sharp].sum()) for axis in (found, up))
    clear = plumb > _CLEARER * level and plumb > _ENOUGH * float(weights.sum())
    return np.asarray(found) if clear else up


def cross_frame(axis: F64) -> tuple[F64, F64]:
    """Return two unit vectors that form a right-handed frame with an axis (3,)."""
    east = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    east /= np.linalg.norm(east)
    return east, np.cross(axis, east)


def _peaks(sample: Sample) -> list[F64]:
    """Return the densest directions of the normals, the densest first."""
    ends = np.cumsum(sample.surface)
    at = np.searchsorted(ends, (np.arange(_SAMPLED) + 0.5) / _SAMPLED * ends[-1])
    picked = sample.normals[np.minimum(at, len(ends) - 1)].astype(np.float32)
    sharpness = np.float32(0.5 / np.radians(_WIDTHS[0]) ** 2)
    density = np.empty(_SAMPLED)
    for start in range(0, _SAMPLED, _BLOCK):
        squared = (picked[start : start + _BLOCK] @ picked.T) ** 2
        density[start : start + _BLOCK] = np.exp(sharpness * (squared - 1.0)).sum(axis=1)
    found: list[F64] = []
    while len(found) < _PEAKS and density.max() > 0.0:
        top = int(density.argmax())
        peak = _climb(sample, picked[top].astype(np.float64))
        found.append(peak)
        near = np.maximum(np.abs(picked @ peak), np.abs(picked @ picked[top]))
        density[near > np.cos(np.radians(_APART))] = 0.0
    return found


def _fit_plane(sample: Sample, start: F64) -> F64:
    """Return the normal of the plane near most of the surface, starting from a direction; for rough ground."""
    normal = start
    for share in _SLABS:
        heights = sample.places @ normal
        east, north = (sample.places @ axis for axis in cross_frame(normal))
        width = share * float(
            np.sqrt(np.ptp(np.quantile(east, [0.02, 0.98])) * np.ptp(np.quantile(north, [0.02, 0.98])))
        )
        if not width > 0.0:
            return normal
        counts, edges = np.histogram(
            heights, max(1, min(200, int(np.ptp(heights) / width * 2.0))), weights=sample.mixed
        )
        center = 0.5 * (edges[counts.argmax()] + edges[counts.argmax() + 1])
        near = np.exp(-0.5 * ((heights - center) / width) ** 2) * sample.mixed
        if not near.sum() > _LEAST_NEAR * sample.mixed.sum():  # a perfect plane on edge: its slab has no thickness
            return normal
        about = sample.places - near @ sample.places / near.sum()
        normal = np.linalg.eigh((about.T * near) @ about)[1][:, 0]
    return np.asarray(normal)


def _climb(sample: Sample, start: F64) -> F64:
    """Return the peak of the density of normals, by mean shift from a direction."""
    peak = start
    for width in _WIDTHS:
        near = np.exp(0.5 / np.radians(width) ** 2 * ((sample.normals @ peak) ** 2 - 1.0)) * sample.surface
        peak = np.linalg.eigh((sample.normals.T * near) @ sample.normals)[1][:, 2]
    return np.asarray(peak)
