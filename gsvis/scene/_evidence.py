"""Measure the figures that distinguish an object, rooms and an open place, by rays through the voxel grid.

Frame and units are those of the grid: voxels. Everything is deterministic. This module knows no kind and no camera.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gsvis.scene._kernels.voxels import free_lengths
from gsvis.scene._occupancy import SOLID, Occupancy
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.kinds import Evidence

__all__ = [
    "footprint",
    "gather",
    "level_directions",
    "ray_lengths",
    "shares_seen",
    "some_voxels",
    "sphere_directions",
    "stopped_share",
    "with_ground",
]

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

EYES = 64
TARGETS = 2048
OUTSIDE = 96
_SHEET = 2.5  # voxels before a target at which a line of sight ends: a thin sheet fills up to three
_FAR = 1.5  # radii of the box at which eyes outside of it are
_LOWEST = -0.2  # sine of the lowest elevation of these eyes
_SPREAD = 256  # directions over the sphere
_ELEVATIONS = (2.0, 8.0, 15.0)  # degrees of level directions; below the horizon is ground
_AZIMUTHS = 24
_CHUNK = 1 << 20


def gather(space: Occupancy, within: Mask, seen: Gaussians, up: F64) -> Evidence:
    """Measure what eyes within and outside see, and whether there is a roof.

    Args:
        space: The grid over the scene.
        within: (X, Y, Z) mask of the enclosed space; may be empty.
        seen: The Gaussians that can be seen.
        up: (3,) unit up axis.

    Returns:
        The evidence; `surrounded` and `walkable` are 0 until `with_ground` measures them.
    """
    shape = np.array(space.depth.shape)
    targets = _spread_out(space.voxels_of(seen.means), TARGETS)
    inner = some_voxels(within)
    outer = 0.5 * shape + _FAR * 0.5 * np.linalg.norm(shape) * _outside(up)
    around = sphere_directions(_SPREAD)
    above = around[around @ up >= np.sqrt(0.5)]
    height, side = _sides(shape, up)
    return Evidence(
        seen_within=_seen_by_any(space, inner, targets),
        seen_outside=_seen_by_any(space, outer, targets),
        roofed=float(stopped_share(space, inner, above).mean()) if len(inner) else 0.0,
        surrounded=0.0,
        walkable=0.0,
        flatness=height / side,
    )


def with_ground(found: Evidence, space: Occupancy, standing: Mask, up: F64) -> Evidence:
    """Return the evidence with the figures for eyes that stand on the ground.

    Args:
        found: The evidence so far.
        space: The grid over the scene.
        standing: (X, Y, Z) voxels where a visitor's eye could be; may be empty.
        up: (3,) unit up axis.
    """
    eyes = some_voxels(standing)
    if len(eyes) == 0:
        return found
    level = level_directions(up)
    surrounded = float(stopped_share(space, eyes, level).mean())
    return replace(found, surrounded=surrounded, walkable=footprint(standing, up))


def footprint(mask: Mask, up: F64) -> float:
    """Return the share of the columns of a grid (X, Y, Z) that hold a voxel of a mask."""
    return float(mask.any(axis=int(np.abs(up).argmax())).mean())


def ray_lengths(space: Occupancy, starts: F64, directions: F64, lengths: F64) -> F64:
    """Return (R,) lengths of rays until half of their light is lost, in voxels; infinite if nothing stops them."""
    found = np.empty(len(starts))
    for begin in range(0, len(starts), _CHUNK):
        part = slice(begin, begin + _CHUNK)
        rays = (np.ascontiguousarray(each[part], np.float64) for each in (starts, directions, lengths))
        free_lengths(space.depth, *rays, SOLID, found[part])
    return found


def stopped_share(space: Occupancy, eyes: F64, directions: F64) -> F64:
    """Return the share (E,) of the directions (D, 3) in which each of the eyes (E, 3) sees something.

    Args:
        space: The grid.
        eyes: Eyes in voxels.
        directions: Unit vectors.
    """
    count = len(directions)
    starts = np.repeat(eyes, count, axis=0)
    lengths = np.full(len(starts), 4.0 * float(max(space.depth.shape)))
    stopped = np.isfinite(ray_lengths(space, starts, np.tile(directions, (len(eyes), 1)), lengths))
    return np.asarray(stopped.reshape(len(eyes), count).mean(axis=1))


def sphere_directions(count: int) -> F64:
    """Return (count, 3) unit vectors, evenly spread by the golden angle."""
    i = np.arange(count) + 0.5
    z = 1.0 - 2.0 * i / count
    turn = np.pi * (1.0 + np.sqrt(5.0)) * i
    flat = np.sqrt(1.0 - z * z)
    return np.stack([np.cos(turn) * flat, np.sin(turn) * flat, z], axis=1)


def level_directions(up: F64) -> F64:
    """Return (D, 3) unit vectors near the horizon."""
    east = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    east /= np.linalg.norm(east)
    frame = np.stack([east, np.cross(up, east), up])
    turns = 2.0 * np.pi * np.arange(_AZIMUTHS) / _AZIMUTHS
    rows = [
        np.stack([np.cos(e) * np.cos(turns), np.cos(e) * np.sin(turns), np.full(_AZIMUTHS, np.sin(e))], axis=1)
        for e in np.radians(_ELEVATIONS)
    ]
    return np.asarray(np.concatenate(rows) @ frame)


def _outside(up: F64) -> F64:
    """Return (D, 3) directions from the scene to eyes outside of it."""
    spread = sphere_directions(OUTSIDE)
    return spread[spread @ up >= _LOWEST]


def some_voxels(mask: Mask, count: int = EYES) -> F64:
    """Return up to `count` centers of voxels of a mask, evenly chosen."""
    voxels = np.flatnonzero(mask)
    if len(voxels) > count:
        voxels = np.sort(np.random.default_rng(0).choice(voxels, count, replace=False))
    return np.asarray(np.stack(np.unravel_index(voxels, mask.shape), axis=1) + 0.5, np.float64)


def _spread_out(points: F64, count: int) -> F64:
    """Return some of the points (P, 3), spread along x; independent of the order of the Gaussians."""
    order = np.argsort(points[:, 0], kind="stable")
    return points[order[np.linspace(0, len(points) - 1, min(count, len(points))).astype(np.int64)]]


def shares_seen(space: Occupancy, eyes: F64, seen: Gaussians) -> F64:
    """Return the share (E,) of the Gaussians on the grid that each eye sees; eyes (E, 3) are in voxels."""
    targets = _spread_out(space.voxels_of(seen.means), EYES)
    return np.asarray(_sees(space, eyes, targets).mean(axis=1)) if len(targets) else np.zeros(len(eyes))


def _seen_by_any(space: Occupancy, eyes: F64, targets: F64) -> float:
    """Return the share of the targets (T, 3) with a free line to at least one of the eyes (E, 3)."""
    if len(eyes) == 0 or len(targets) == 0:
        return 0.0
    return float(_sees(space, eyes, targets).any(axis=0).mean())


def _sees(space: Occupancy, eyes: F64, targets: F64) -> Mask:
    """Return a mask (E, T): whether there is a free line from each of the eyes (E, 3) to each of the targets (T, 3)."""
    ways = targets[None] - eyes[:, None]
    lengths = np.maximum(np.linalg.norm(ways, axis=2), 1e-9)
    ways /= lengths[:, :, None]
    starts = np.repeat(eyes, len(targets), axis=0)
    stops = ray_lengths(space, starts, ways.reshape(-1, 3), lengths.ravel() - _SHEET)
    return np.asarray(np.isinf(stops).reshape(len(eyes), -1), bool)


def _sides(shape: NDArray[np.int64], up: F64) -> tuple[float, float]:
    """Return height and narrower side of the grid, voxels."""
    axis = int(np.abs(up).argmax())
    return float(shape[axis]), float(np.delete(shape, axis).min())
