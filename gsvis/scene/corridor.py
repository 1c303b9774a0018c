"""Restrict a navigable space to the part along a walk, or find the space along a walk.

Scene frame and units. This module knows nothing about visibility.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.errors import SceneError
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace

__all__ = ["corridor", "fill_in", "share_in_solid", "space_along", "space_walked"]

F64 = NDArray[np.float64]

_INSIDE = 0.5  # share of the positions that have to be near navigable space
_MOST_POINTS = 4_000_000
_AT_ONCE = 1 << 18  # voxels whose distances from a walk are found together


def corridor(space: NavigableSpace, positions: ArrayLike, margin: float | None = None) -> NavigableSpace:
    """Return the free voxels of a space along a walk.

    Args:
        space: Allowed viewpoints in the scene.
        positions: (T, 3) the walk, in the space's frame, with straight lines between positions.
        margin: Distance from the walk, scene units, within which voxels are kept; None means 3 voxels.

    Returns:
        The same grid with fewer free voxels.

    Raises:
        ValueError: If the margin is not a finite number > 0, or if fewer than half of the positions lie within it of a
            free voxel: the walk has a different frame or scene, or leads through something solid.

    Examples:
        >>> room = NavigableSpace.from_box((0, 0, 0), (4, 4, 4), 16)
        >>> corridor(room, [[0.5, 2, 2], [3.5, 2, 2]], margin=0.5).volume < 0.2 * room.volume
        True
    """
    from scipy import ndimage  # here: it takes long to import, and few need it

    points = _check.floats("positions", positions, ("T", 3), np.float64)
    if len(points) == 0:
        raise ValueError("positions: expected at least one, got none")
    margin = 3.0 * space.voxel_size if margin is None else float(margin)
    if not (np.isfinite(margin) and margin > 0.0):
        raise ValueError(f"margin: expected a finite number > 0, got {margin!r}")
    reach = margin / space.voxel_size + 0.5  # voxels, between centers
    shape = np.array(space.free.shape)
    to_free = np.asarray(ndimage.distance_transform_edt(~space.free))
    own, held = _voxels(space, points)
    near = float(np.mean(held & (to_free[tuple(np.where(held[:, None], own, 0).T)] <= reach)))
    if near < _INSIDE and (solid := share_in_solid(space, points)) >= _INSIDE:
        raise ValueError(
            f"path: expected positions in the navigable space of the scene, got {solid:.0%} of them inside something"
            " solid; give a walk through the open"
        )
    if near < _INSIDE:
        raise ValueError(
            f"path: expected positions in the navigable space of the scene, got {near:.0%} of them within {margin:.3g}"
            " of it; bring the path into the scene's frame (retarget it), or raise the margin"
        )
    way, held = _voxels(space, fill_in(points, 0.5 * space.voxel_size))
    on_way = np.zeros(shape, bool)
    on_way[tuple(way[held].T)] = True
    kept = space.free & (np.asarray(ndimage.distance_transform_edt(~on_way)) <= reach)
    return replace(space, free=kept, rule=f"{space.rule}, along a path")


def space_along(
    g: Gaussians, positions: ArrayLike, margin: float, *, resolution: int = 160, up: ArrayLike | str | None = None
) -> NavigableSpace:
    """Return the clear voxels along a walk, in a scene of any kind.

    `corridor` keeps a part of a space, which covers only one kind of place. This function finds rooms, streets and
    gardens along the same walk.

    Args:
        g: The scene.
        positions: (T, 3) points of the walk, scene frame; see `fill_in`.
        margin: Distance from a point, scene units, within which eyes may be.
        resolution: Voxels along the longest side of the box, 8 to 384.
        up: (3,) direction or an axis such as "+z"; guessed by default.

    Raises:
        ValueError: If an argument is out of range.
        SceneError: If nothing is clear along the walk.
    """
    from scipy import ndimage  # slow to import, seldom needed
    from scipy.spatial import cKDTree

    points = _check.floats("positions", positions, ("T", 3), np.float64)
    if len(points) == 0:
        raise ValueError("positions: expected at least one, got none")
    if not (np.isfinite(margin) and margin > 0.0):
        raise ValueError(f"margin: expected a finite number > 0, got {margin!r}")
    space = NavigableSpace.from_scene(g, resolution=resolution, up=up, seeds=points)
    clear = np.asarray(~ndimage.binary_dilation(space.occupied))
    walk = cKDTree(points)
    free = np.zeros(clear.shape, bool)
    layers = max(1, _AT_ONCE // clear[0].size)
    for start in range(0, len(clear), layers):
        some = np.argwhere(clear[start : start + layers]) + np.array([start, 0, 0])
        centers = space.origin + space.voxel_size * (some + 0.5)
        near = some[walk.query(centers, distance_upper_bound=margin)[0] <= margin]
        free[tuple(near.T)] = True
    if not free.any():
        raise SceneError(f"no navigable space: nothing within {margin:.3g} of the walk is clear", "raise the margin")
    return replace(space, free=free, rule="clear, along a walk")


def space_walked(space: NavigableSpace, positions: ArrayLike, margin: float | None = None) -> NavigableSpace:
    """Return the free voxels of a space along a walk, together with the voxels of the walk itself.

    Args:
        space: Allowed viewpoints in the scene; its grid has to hold the walk.
        positions: (T, 3) the walk, in the space's frame, with straight lines between positions.
        margin: Distance from the walk, scene units, within which free voxels are kept; None means 3 voxels.

    Raises:
        ValueError: If the margin is not a finite number > 0, or fewer than half of the positions lie on the grid,
            because the walk has a different frame or scene.
    """
    from scipy import ndimage  # here: it takes long to import, and few need it

    points = _check.floats("positions", positions, ("T", 3), np.float64)
    if len(points) == 0:
        raise ValueError("positions: expected at least one, got none")
    margin = 3.0 * space.voxel_size if margin is None else float(margin)
    if not (np.isfinite(margin) and margin > 0.0):
        raise ValueError(f"margin: expected a finite number > 0, got {margin!r}")
    own, held = _voxels(space, points)
    if held.mean() < _INSIDE:
        raise ValueError(
            f"path: expected positions in the scene, got {held.mean():.0%} of them there; bring the path into the"
            " scene's frame (retarget it)"
        )
    walked = np.zeros(space.free.shape, bool)
    walked[tuple(own[held].T)] = True
    way, on_grid = _voxels(space, fill_in(points, 0.5 * space.voxel_size))
    on_way = walked.copy()
    on_way[tuple(way[on_grid].T)] = True
    near = np.asarray(ndimage.distance_transform_edt(~on_way)) <= margin / space.voxel_size + 0.5
    free = walked | (space.free & near)
    return replace(space, free=free, occupied=space.occupied & ~walked, rule=f"{space.rule}, along a path")


def share_in_solid(space: NavigableSpace, positions: ArrayLike) -> float:
    """Return the share of positions (T, 3) that lie in voxels which stop light; 0 without any."""
    points = _check.floats("positions", positions, ("T", 3), np.float64)
    own, held = _voxels(space, points)
    return float(np.mean(space.occupied[tuple(own[held].T)])) * float(held.mean()) if held.any() else 0.0


def _voxels(space: NavigableSpace, points: F64) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the voxel of each point, and whether it lies on the grid."""
    shape = np.array(space.free.shape)
    voxels = np.floor(np.clip((points - space.origin) / space.voxel_size, -1.0, shape)).astype(np.int64)
    return voxels, np.all((voxels >= 0) & (voxels < shape), axis=1)


def fill_in(points: F64, step: float) -> F64:
    """Return points (T, 3) with more points on the lines between them, up to 4 million; no step exceeds `step`."""
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    step = max(step, float(lengths.sum()) / _MOST_POINTS)
    counts = np.maximum(np.ceil(lengths / step).astype(np.int64), 1)
    starts = np.repeat(np.arange(len(counts)), counts)
    along = (np.arange(len(starts)) - np.repeat(np.cumsum(counts) - counts, counts)) / counts[starts]
    between = points[starts] + along[:, None] * np.diff(points, axis=0)[starts]
    return np.concatenate([between, points[-1:]])
