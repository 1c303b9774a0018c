"""Find navigable space in a scene of many places, on squares small enough for a grid to resolve rooms.

A grid over a large scene has voxels wider than doors, so that rooms appear closed. Therefore the search runs on
parcels: squares that hold two million Gaussians at the usual density, each with its surroundings. Scene frame and
units. Gives spaces; draws and traces nothing. docs/design/033-kinds-of-space.md.
"""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import replace
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from gsvis.errors import SceneError
from gsvis.jobs.graph import Facts
from gsvis.scene.axes import axis_vector
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import MAX_RESOLUTION, NavigableSpace
from gsvis.world.tiles import MOST_VOXELS, near_tile, within_tile

__all__ = [
    "AROUND",
    "PARCEL",
    "VOXELS",
    "find_side",
    "indoors",
    "join_spaces",
    "lay_parcels",
    "mixed_space",
    "rows_near",
]

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

PARCEL = 2_000_000
"""Approximate number of Gaussians of a parcel."""

AROUND = 0.4
"""Width of the surroundings of a parcel, as a multiple of its side."""

VOXELS = 200
"""Voxels along the side of a parcel."""

_COVERAGE = 0.98  # of the centers on each axis, within the lattice and within the box of a grid
_CELLS = 256  # along the longer side of a scene, in which it is counted how dense it is
_FEWEST = 4  # Gaussians of the sample in a parcel
_MOST_JOINED = 1 << 24  # voxels of the grid of all parcels
_MOST_PARCELS = 8  # times as many as the Gaussians ask for, and as many more
_MOST_NEAR = 4_000_000  # Gaussians in and around a parcel
_TARGETS = 4096


def find_side(sample: Gaussians, every: int, up: str, most: int = PARCEL) -> float:
    """Return the side of parcels of a scene; 0 if it lies in a point.

    Args:
        sample: One in `every` of its visible Gaussians.
        every: Number of Gaussians that one of the sample represents.
        up: Axis that points upward, such as "+z".
        most: Approximate number of Gaussians of a parcel, where the scene has its usual density.
    """
    across, low, longest = _footprint(sample, up)
    if not (len(across) and longest > 0.0):
        return 0.0
    cells = np.floor((across - low) / longest * (_CELLS - 1e-6)).astype(np.int64)
    counts = np.bincount(cells[:, 0] * _CELLS + cells[:, 1])
    dense = float(np.median(np.repeat(counts, counts)))  # usual number of Gaussians of a cell, weighted by Gaussians
    return longest / _CELLS * float(np.sqrt(most / (every * dense)))


def lay_parcels(sample: Gaussians, every: int, up: str, most: int = PARCEL) -> list[Facts]:
    """Return the squares of a lattice over a scene that hold Gaussians of a sample; see `find_side`.

    Squares are enlarged if there would be too many, as in a scene with most Gaussians in one spot.

    Returns:
        For each square `low` and `high` on the two level `axes`, and `up`.
    """
    across, low, _ = _footprint(sample, up)
    side = find_side(sample, every, up, most)
    bound = _MOST_PARCELS * (1.0 + every * len(across) / most)
    if side == 0.0:
        return []
    while True:
        places, held = np.unique(np.floor((across - low) / side).astype(np.int64), axis=0, return_counts=True)
        places = places[held >= _FEWEST]
        if len(places) <= bound:
            break
        side *= 2.0
    corners = [(low + side * at, low + side * (at + 1)) for at in places]
    axes = _level_axes(up)
    return [{"low": first.tolist(), "high": last.tolist(), "axes": axes, "up": up} for first, last in corners]


def rows_near(parts: Iterable[Gaussians], square: Facts) -> Gaussians:
    """Return the Gaussians in and around a square, from a scene in parts; too many are replaced by fewer, wider ones.

    Args:
        parts: The scene, part by part; iterated over twice.
        square: The square.
    """
    count = sum(int(np.count_nonzero(near_tile(g.means, square, AROUND))) for g in parts)
    every = max(1, -(-count // _MOST_NEAR))
    near = Gaussians.concatenate([g[np.flatnonzero(near_tile(g.means, square, AROUND))[::every]] for g in parts])
    if every == 1:
        return near
    return replace(near, scales=near.scales * every**0.5)


def indoors(space: NavigableSpace) -> Mask:
    """Return (X, Y, Z) the free voxels of a space with an occupied voxel above them in its grid."""
    return space.free & space.covered()


def mixed_space(near: Gaussians, square: Facts, voxel_size: float) -> NavigableSpace | None:
    """Return the navigable space in a square, in rooms and on open ground; None if there is none.

    Args:
        near: Gaussians in and around the square.
        square: The square: `low` and `high` on `axes`, and `up`.
        voxel_size: Side of voxels, scene units; enlarged if there would be too many.
    """
    if len(near) == 0:
        return None
    low, high = near.bounds(_COVERAGE)
    sides = (high - low).astype(np.float64)
    size = max(voxel_size, float(np.cbrt(sides.prod() / MOST_VOXELS)), 1e-12)
    resolution = int(np.clip(np.ceil(sides.max() / size), 8, MAX_RESOLUTION))
    with suppress(SceneError):
        found = NavigableSpace.from_scene(near, mixed=True, resolution=resolution, up=square["up"])
        return within_tile(found, square)
    return None


def join_spaces(spaces: Iterable[NavigableSpace], below: NavigableSpace | None = None) -> NavigableSpace:
    """Return several spaces on one grid, with voxels of their median size, or larger if there would be too many.

    Args:
        spaces: At least one; iterated over twice. If they overlap, voxels that are free in one are free.
        below: A further space with free voxels, whose walls count only where no other space is known.
    """
    lasts = [] if below is None else [below]
    lows = []
    highs = []
    sizes = list[float]()
    looked_at = []
    count = 0
    for each in chain(spaces, lasts):
        count += 1
        lows.append(each.origin)
        highs.append(each.origin + each.voxel_size * np.array(each.free.shape))
        if each is not below:
            sizes.append(each.voxel_size)
            looked_at.append(each.targets)
    low = np.min(lows, axis=0)
    high = np.max(highs, axis=0)
    finest = float(np.cbrt((high - low).prod() / _MOST_JOINED))
    size = max(float(np.median(sizes)), finest)
    x, y, z = (int(n) for n in np.ceil((high - low) / size - 1e-6))
    free, occupied, known = (np.zeros((x, y, z), bool) for _ in range(3))
    for each in chain(spaces, lasts):
        block, free_there, occupied_there = each.on_grid(low, size, (x, y, z))
        free[block] |= free_there
        occupied[block] |= occupied_there & ~known[block] if each is below else occupied_there
        known[block] = True
    targets = np.concatenate(looked_at)
    some = np.linspace(0, len(targets) - 1, min(len(targets), _TARGETS)).astype(np.int64)
    return NavigableSpace(low, size, free, each.up, occupied & ~free, targets[some], each.rule, each.kind, count)


def _footprint(sample: Gaussians, up: str) -> tuple[F64, F64, float]:
    """Return (M, 2) the level coordinates of centers in the robust box, its lowest corner, and its longer side."""
    axes = _level_axes(up)
    if len(sample) == 0:
        return np.zeros((0, 2)), np.zeros(2), 0.0
    low, high = (each[axes] for each in sample.bounds(_COVERAGE))
    across = sample.means[:, axes].astype(np.float64)
    return across[((across >= low) & (across <= high)).all(axis=1)], low, float((high - low).max())


def _level_axes(up: str) -> list[int]:
    """Return the two axes that are level."""
    upright = int(np.abs(axis_vector(up)).argmax())
    return [axis for axis in range(3) if axis != upright]
