"""Choose the origin to which centers of a scene are relative, so that float32 resolves them.

A scene in projected coordinates lies millions of units from (0, 0, 0), where float32 steps by a quarter of a unit. Its
centers are kept relative to an origin near them, subtracted in float64. The rule compares the step of float32 with the
size of the Gaussians, so it is independent of units.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis.scene.gaussians import Gaussians

__all__ = [
    "SAMPLE",
    "choose_origin",
    "needs_origin",
    "place_scene",
    "sample_rows",
    "settle_origin",
    "size_of_gaussians",
]

F64 = NDArray[np.float64]
Triple = tuple[float, float, float]

SAMPLE = 1024
"""Number of rows of a file that decide its origin."""
_HALF_STEP = 2.0**-24  # largest relative error of float32
_FINE = 1e-3  # largest error of centers given in double precision, as a share of a Gaussian's size
_COARSE = 1e-2  # the same for centers given in float32, which have the error already
# distance of a scene from (0, 0, 0), in extents, for double precision and for float32
_AWAY = 4.0
_FAR_AWAY = 16.0


def sample_rows(count: int) -> NDArray[np.int64]:
    """Return the rows of a file of `count` rows that decide its origin: spread evenly, at most `SAMPLE`."""
    return np.unique(np.linspace(0, count - 1, min(count, SAMPLE)).astype(np.int64))


def size_of_gaussians(scales: ArrayLike) -> float:
    """Return the typical size of Gaussians: the median of their middle standard deviations; 0 if there are none."""
    middle = np.median(np.asarray(scales, np.float64).reshape(-1, 3), axis=1)
    middle = middle[np.isfinite(middle)]
    return float(np.median(middle)) if len(middle) else 0.0


def needs_origin(origin: ArrayLike, scene: Gaussians, scale: float = 1.0) -> bool:
    """Return whether a point lies so far outside a scene that float32 cannot resolve its Gaussians around it.

    Args:
        origin: (3,) the point.
        scene: The scene, around (0, 0, 0).
        scale: Factor by which the scene will be enlarged.
    """
    rows = sample_rows(len(scene))
    reach = float(np.abs(np.asarray(origin, np.float64)).max())
    extent = _extent(scene.means[rows].astype(np.float64))
    return reach > _AWAY * scale * extent and reach * _HALF_STEP > _FINE * scale * size_of_gaussians(scene.scales[rows])


def _extent(points: F64) -> float:
    """Return the longest side of the box of the middle nine tenths of points."""
    low, high = np.quantile(points, [0.05, 0.95], axis=0)
    return float((high - low).max())


def choose_origin(points: ArrayLike, scales: ArrayLike, *, double: bool) -> Triple:
    """Return the origin of a scene from a sample of its Gaussians; (0, 0, 0) if float32 resolves their centers.

    Args:
        points: (M, 3) centers in the coordinates of the file; those that are not finite do not count.
        scales: (M, 3) standard deviations.
        double: Whether the file has centers in double precision.

    Returns:
        A point near their median, rounded to a power of ten that is at least their extent.
    """
    places = np.asarray(points, np.float64)
    good = np.isfinite(places).all(axis=1)
    if not good.any():
        return 0.0, 0.0, 0.0
    middle = np.median(places[good], axis=0)
    extent = _extent(places[good])
    size = size_of_gaussians(scales)
    reach = float(np.abs(middle).max())
    if reach <= (_AWAY if double else _FAR_AWAY) * extent or reach >= 1e30:
        return 0.0, 0.0, 0.0
    if reach * _HALF_STEP <= (_FINE if double else _COARSE) * size:
        return 0.0, 0.0, 0.0
    unit = 10.0 ** math.ceil(math.log10(max(extent, 10.0 * size, 1e-6 * reach)))
    x, y, z = (float(round(value / unit) * unit) + 0.0 for value in middle)
    return x, y, z


def place_scene(scene: Gaussians, rotation: ArrayLike, translation: ArrayLike, scale: float) -> Gaussians:
    """Return a scene rotated and scaled about (0, 0, 0) of its source, then moved; composed in double precision.

    Args:
        scene: The scene; its origin is part of its place.
        rotation: (3, 3) rotation.
        translation: (3,) in new units, of any size.
        scale: New units per old unit, > 0.

    Returns:
        The scene with an origin only where float32 could not resolve its Gaussians without one.
    """
    shift = np.asarray(translation, np.float64)
    turn = np.asarray(rotation, np.float64)
    moved = scale * (turn @ np.asarray(scene.facts.origin)) + shift
    here = scene.with_facts(replace(scene.facts, origin=(0.0, 0.0, 0.0)))
    if not needs_origin(moved, here, scale):
        return here.transform(turn, moved, scale)
    placed = here.transform(turn, scale=scale)
    x, y, z = (value + 0.0 for value in moved.tolist())
    return placed.with_facts(replace(placed.facts, origin=(x, y, z)))


def settle_origin(scene: Gaussians, stated: Triple | None = None) -> Gaussians:
    """Return a scene as read, with an origin only where float32 could not resolve its Gaussians without one.

    Args:
        scene: The scene as stored in its file.
        stated: The origin that the file states, if it states one; it is kept.
    """
    if any(scene.facts.origin):
        if not needs_origin(scene.facts.origin, scene):
            return scene.with_origin((0.0, 0.0, 0.0))
        return scene if stated is None else scene.with_origin(stated)
    rows = sample_rows(len(scene))
    return scene.with_origin(choose_origin(scene.means[rows], scene.scales[rows], double=False))
