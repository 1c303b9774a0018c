"""Find navigable space in a box that the facts of a scene state: the voxels that are free and can be reached.

Built-in scenes and files converted from them state such a box, so both have the same eyes. A box may be rotated; its
voxels then first lie along its own sides. Frame and units of the result are the scene's own.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.errors import SceneError
from gsvis.scene._occupancy import ROOM, Occupancy, only_visible
from gsvis.scene._turned import Pose, bring_back
from gsvis.scene.core import find_core
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.kinds import SpaceKind
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.upright import find_up

__all__ = ["stated_space"]

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Mask = NDArray[np.bool_]

_RESOLUTION = 160
_MAX_ALPHA = 0.25
_CLEARANCE = 1.0  # voxels
_GROWN = 0.25  # longest sides of the box around it in which the grid shows what stops light
_TIE = 1e-3  # voxels, by which rounding may be off
_NEAR = 2  # voxels around the stated eye in which a free one is looked for


def stated_space(g: Gaussians, *, up: ArrayLike | None = None) -> NavigableSpace | None:
    """Return the free voxels in the box that a scene states; None if it states none.

    Args:
        g: The scene.
        up: (3,) up axis; by default the stated or likely one of the scene.

    Raises:
        SceneError: If nothing in the box is free, or nothing of the scene can be seen.
    """
    if g.facts.box is None:
        return None
    seen = only_visible(g)
    above = find_up(g, check=False).up if up is None else np.asarray(up, np.float64)
    above = _check.unit_vectors("up", np.reshape(above, (1, -1)))[0].astype(np.float64)
    kind = SpaceKind("given", "a box that the scene states", None, "inside")
    rule = "free, in the stated box"
    low, high = np.asarray(g.facts.box)
    axes = g.facts.box_axes
    if np.array_equal(axes, np.eye(3)):
        space, free = _search(seen, low, high, g.facts.eye, g.facts.clearance)
        occupied = space.occupied & ~free
        return NavigableSpace(space.origin, space.voxel_size, free, above, occupied, space.targets(seen), rule, kind)
    pose = Pose(axes.T, axes @ (0.5 * (low + high)))
    half = 0.5 * (high - low)
    eye = None if g.facts.eye is None else pose.points(np.asarray(g.facts.eye)[None])[0]
    turned = pose.gaussians(seen)
    space, free = _search(turned, -half, half, eye, g.facts.clearance)
    origin, size, (free, occupied) = bring_back(space.origin, space.voxel_size, [free, space.occupied], pose)
    targets = pose.back(space.targets(turned))
    return NavigableSpace(origin, size, free, above, occupied & ~free, targets, rule, kind)


def _search(
    seen: Gaussians, low: F64, high: F64, eye: ArrayLike | None, clearance: float | None
) -> tuple[Occupancy, Mask]:
    """Return a grid over the part of a scene near a box, and (X, Y, Z) the voxels in the box that can be reached.

    Raises:
        SceneError: If there are no such voxels.
    """
    side = float((high - low).max())
    if not side > 0.0:
        raise SceneError("no navigable space: the box that the scene states is a point", "give a box")
    core = find_core(seen)
    grid_low = np.minimum(np.maximum(core.low, low - _GROWN * side), low)
    grid_high = np.maximum(np.minimum(core.high, high + _GROWN * side), high)
    # Whole voxels along the longest side of the box, about its middle, so that no rounding decides.
    size = side / np.ceil(_RESOLUTION * side / float((grid_high - grid_low).max()) - _TIE)
    counts = np.maximum(np.floor((high - low) / size + 0.5 - _TIE), 1.0)
    before, after = (np.ceil(beyond / size - _TIE) for beyond in (low - grid_low, grid_high - high))
    start = 0.5 * (low + high) - size * (0.5 * counts + before)
    total = before + counts + after
    space = Occupancy.from_gaussians(
        [seen],
        start,
        start + size * total,
        resolution=int(total.max()),
        max_alpha=_MAX_ALPHA,
        clearance=_CLEARANCE,
    )
    free = _reached(space, _far_enough(space, before.astype(np.int64), counts.astype(np.int64), clearance), eye)
    if not free.any():
        raise SceneError("no navigable space: nothing in the box that the scene states is free", "give a box")
    return space, free


def _far_enough(space: Occupancy, start: I64, counts: I64, clearance: float | None) -> Mask:
    """Return (X, Y, Z) the clear voxels of a box that are farther than a distance from occupied voxels.

    Args:
        space: The grid.
        start: (3,) first voxel of the box.
        counts: (3,) number of its voxels along each side.
        clearance: The distance, accurate to half a voxel; None for no condition.
    """
    free = np.zeros(space.clear.shape, bool)
    box = tuple(slice(a, a + n) for a, n in zip(start, counts, strict=True))
    free[box] = space.clear[box]
    if clearance is None:
        return free
    from scipy import ndimage  # here: it takes long to import, and few need it

    reach = int(min(np.ceil(clearance / space.voxel_size), max(free.shape))) + 1  # what lies beyond changes nothing
    low = np.maximum(start - reach, 0)
    occupied = space.occupied[tuple(slice(a, b) for a, b in zip(low, start + counts + reach, strict=True))]
    if occupied.any():
        apart = ndimage.distance_transform_edt(~occupied, sampling=space.voxel_size)
        mine = tuple(slice(a, a + n) for a, n in zip(start - low, counts, strict=True))
        free[box] &= apart[mine] + 0.5 * space.voxel_size > clearance
    return free


def _reached(space: Occupancy, free: Mask, eye: ArrayLike | None) -> Mask:
    """Return the connected part (X, Y, Z) that holds an eye; without an eye, all but small parts."""
    from scipy import ndimage  # here: it takes long to import, and few need it

    labels, _ = ndimage.label(free)
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    if eye is not None:
        voxel = np.floor((np.asarray(eye, np.float64) - space.origin) / space.voxel_size).astype(np.int64)
        start = np.maximum(voxel - _NEAR, 0)
        stop = np.maximum(voxel + _NEAR + 1, 0)
        around = labels[tuple(slice(a, b) for a, b in zip(start, stop, strict=True))]
        if around.any():
            return np.asarray(labels == np.bincount(around[around > 0]).argmax(), bool)
    return np.asarray((sizes >= max(1.0, ROOM * sizes.max()))[labels] & free, bool)
