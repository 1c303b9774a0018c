"""Find where eyes belong in a scene whose kind is stated: around an object, in rooms, or above the ground of a place.

Nothing is weighed here. `_eyes.py` decides where the kind is not stated, and its rules hold here too.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsvis.scene._evidence import footprint
from gsvis.scene._eyes import Around, Look, above_ground, eye_heights, stand_around
from gsvis.scene._occupancy import Occupancy
from gsvis.scene.kinds import WALKABLE, Kind, SpaceKind

__all__ = ["find_stated"]

_STATED = "as stated"


def find_stated(look: Look, kind: Kind) -> tuple[Occupancy, NDArray[np.bool_], str, SpaceKind]:
    """Find the voxels where eyes belong in a scene of a stated kind.

    What lies beyond the detail of a scene is no place to stand in, and counts for no size.

    Args:
        look: What is looked at.
        kind: "object", "rooms" or "open place".

    Returns:
        The grid, (X, Y, Z) the voxels, the name of the rule that chose them, and the kind.

    Raises:
        SceneError: If no voxel is free.
    """
    core = look.core
    up = look.up
    if kind == "object":
        around = Around(core.detail_low, core.detail_high, up if look.up_sure else None)
        space, free = stand_around(look.build, around, widest=core.widest)
        return space, free, "free, around an object", SpaceKind(kind, _STATED, None, str(around))
    space = look.build(core.detail_low, core.detail_high, widest=core.widest)
    if kind == "rooms":
        free, rule, _ = space.choose(up)
        return space, free, rule, SpaceKind(kind, _STATED, None, "inside")
    standing = above_ground(space, up, look.person)
    if footprint(standing, up) >= WALKABLE:
        least, greatest = eye_heights(space, up, look.person)
        eyes = f"{least:.2g} to {greatest:.2g} units above the ground"
        return space, standing, "free, ground below at the height of an eye", SpaceKind(kind, _STATED, None, eyes)
    return space, space.largest_part(), "free, within the detail", SpaceKind(kind, _STATED, None, "within its detail")
