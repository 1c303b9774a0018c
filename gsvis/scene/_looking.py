"""Prepare the search for eyes: select visible Gaussians, find the core of the scene, and rotate it upright."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.scene._eyes import PERSON, Look
from gsvis.scene._occupancy import Occupancy, only_visible
from gsvis.scene._turned import Pose, TurnedParts, is_level, is_square, turn
from gsvis.scene.axes import axis_vector, snap_to_axis
from gsvis.scene.core import find_core
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.upright import Upright, find_up

__all__ = ["MAX_RESOLUTION", "look_upright"]

F64 = NDArray[np.float64]

MAX_RESOLUTION = 384
"""Largest resolution that a caller can choose, in voxels along a side."""

_NO_SEEDS = np.zeros((0, 3))


def look_upright(
    g: Gaussians,
    up: ArrayLike | str | None,
    resolution: int,
    *,
    parts: Iterable[Gaussians] | None = None,
    max_alpha: float = 0.25,
    clearance: float = 1.0,
    coverage: float = 0.98,
    seeds: F64 = _NO_SEEDS,
) -> tuple[Look, Pose | None]:
    """Return the input of the search for eyes, upright, and the rotation; None if the scene was upright already.

    Args:
        g: The scene, or a sample of it.
        up: (3,) direction or an axis such as "+z"; guessed if None.
        resolution: Voxels along the longest side of a grid, 8 to 384.
        parts: The scene part by part, for grids; None uses the visible Gaussians of `g`.
        max_alpha: Share of lost light above which a voxel counts as occupied.
        clearance: Required distance from occupied voxels, in voxels, between centers.
        coverage: Share of the centers inside the box on each axis.
        seeds: (S, 3) positions known to be navigable.

    Raises:
        ValueError: If the resolution or the up axis is invalid.
        SceneError: If nothing can be seen.
    """
    _check.positive_int("resolution", resolution, at_least=8)
    if resolution > MAX_RESOLUTION:
        raise ValueError(f"resolution: expected a value in [8, {MAX_RESOLUTION}], got {resolution!r}")
    seen = only_visible(g)
    upright = _upright(g, up)
    meters = seen.facts.meters_per_unit
    person = None if meters is None else PERSON / meters
    grid = partial(Occupancy.from_gaussians, resolution=resolution, max_alpha=max_alpha, clearance=clearance)
    core = find_core(seen, coverage)
    plan = seen[core.members]  # ignores outliers, which are no walls
    if is_level(upright.up) and is_square(upright.up, plan, core.center):
        build = partial(grid, [seen] if parts is None else parts)
        return Look(build, seen, core, upright.up, upright.sure, seeds, person), None
    pose = turn(upright.up, plan, core.center)
    turned = pose.gaussians(seen)
    build = partial(grid, [turned] if parts is None else TurnedParts(parts, pose))
    above = np.array([0.0, 0.0, 1.0])
    return Look(build, turned, find_core(turned, coverage), above, upright.sure, pose.points(seeds), person), pose


def _upright(g: Gaussians, up: ArrayLike | str | None) -> Upright:
    """Return a given up axis, as a name or a direction (3,), or the likely one if none is given."""
    if up is None:
        found = find_up(g)
        return replace(found, up=snap_to_axis(found.up))
    axis = np.asarray(axis_vector(up) if isinstance(up, str) else up, np.float64)
    return Upright(_check.unit_vectors("up", np.reshape(axis, (1, -1)))[0].astype(np.float64), 1.0, "given")
