"""Use positions that are known to be navigable, such as cameras, unless they contradict the scene.

Scene frame and units. This module knows no kind of scene.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gsvis.scene._evidence import shares_seen
from gsvis.scene._occupancy import Occupancy
from gsvis.scene.core import Core
from gsvis.scene.gaussians import Gaussians

__all__ = ["box_with_seeds", "doubt_far", "doubt_seeds", "hold_seeds"]

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

_FARTHEST = 8.0  # longest sides of a scene, from its middle, at which a seed has to do with it
_MARGIN = 0.02  # of the longest side, around the seeds
_ASKED = 64  # seeds that are asked what they see
_SOME = 0.01  # least share of the scene that a camera sees
_MOST = 0.5  # share of the seeds from which they count as most
_BALL = 2  # voxels around a seed that are free


def box_with_seeds(core: Core, seeds: F64) -> tuple[F64, F64, Mask]:
    """Return the corners of a box that holds a scene and the seeds near it, and (S,) which seeds are near.

    Without seeds it is the box of the scene.

    Args:
        core: The core of the scene.
        seeds: (S, 3) positions.
    """
    middle = 0.5 * (core.low + core.high)
    longest = float((core.high - core.low).max())
    near = np.linalg.norm(seeds - middle, axis=1) <= _FARTHEST * longest
    if not near.any():
        return core.low, core.high, near
    low = seeds[near].min(axis=0)
    high = seeds[near].max(axis=0)
    margin = _MARGIN * max(longest, float((high - low).max()))
    low = np.minimum(core.low, low - margin)
    high = np.maximum(core.high, high + margin)
    return low, high, near


def doubt_seeds(space: Occupancy, seeds: F64, near: Mask, seen: Gaussians) -> str:
    """Return a line that says why seeds contradict a scene; empty if they do not.

    Args:
        space: A grid that holds the scene and the near seeds.
        seeds: (S, 3) positions.
        near: (S,) whether each is near the scene.
        seen: The Gaussians that can be seen.
    """
    count = len(seeds)
    far = count - int(np.count_nonzero(near))
    if far > _MOST * count:
        return doubt_far(far, count)
    places = space.voxels_of(seeds[near])
    if len(places) == 0:
        return ""
    inside = int(np.count_nonzero(space.occupied[tuple(places.astype(np.int64).T)]))
    if inside > _MOST * count:
        return f"{inside:,} of {count:,} cameras or positions are inside something solid: are they in its frame?"
    asked = places[np.linspace(0, len(places) - 1, min(_ASKED, len(places))).astype(np.int64)]
    blind = float(np.mean(shares_seen(space, asked, seen) < _SOME))
    if blind > _MOST:
        return f"{blind:.0%} of the cameras or positions see nothing of the scene: are they in its frame?"
    return ""


def doubt_far(far: int, count: int) -> str:
    """Return a line that says how many seeds are far outside."""
    return f"{far:,} of {count:,} cameras or positions are far outside of the scene: are they in its frame?"


def hold_seeds(space: Occupancy, free: Mask, seeds: F64) -> tuple[Occupancy, Mask]:
    """Return the grid and the free voxels (X, Y, Z), with the surroundings of the seeds marked free.

    Args:
        space: The grid.
        free: (X, Y, Z) voxels that are free without the seeds.
        seeds: (S, 3) positions on the grid.
    """
    from scipy import ndimage  # slow to import, seldom needed

    places = np.clip((seeds - space.origin) / space.voxel_size, 0, np.array(free.shape) - 1).astype(np.int64)
    at = np.zeros(free.shape, bool)
    at[tuple(places.T)] = True
    steps = np.arange(-_BALL, _BALL + 1)
    ball = steps[:, None, None] ** 2 + steps[:, None] ** 2 + steps**2 <= _BALL**2
    around = ndimage.binary_dilation(at & ~free, ball) & ~space.occupied
    return replace(space, occupied=space.occupied & ~at), np.asarray(free | at | around, bool)
