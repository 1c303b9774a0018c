"""Find where eyes belong in a scene of a stated kind: around an object, in rooms, or above the ground of a place.

`_eyes.py` decides if the kind is not stated; its rules for each kind also apply here.
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

    Everything beyond the detail of a scene is ignored.

    Args:
        look: The scene to search.
        kind: "object", "rooms" or "open place".

    Returns:
        The grid, the mask (X, Y, Z) of voxels, the name of the rule that chose them, and the kind.

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
