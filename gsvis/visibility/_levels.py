"""Levels looked at one by one: a Gaussian of the union is visible where any level that has it shows it.

The union itself is no scene: what belongs to the low level alone would hide Gaussians of the high one, and the other
way round. So each level is seen by itself, and what was found is brought together under the ids of the union.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.raycast.directions import NUM_FACES
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.visibility.pvs import CellView

__all__ = ["as_levels", "joined", "level_scenes", "levels_record", "union_of"]

I64 = NDArray[np.int64]


def union_of(scene: Gaussians | Levels) -> Gaussians:
    """The Gaussians that ids are of."""
    return scene.union if isinstance(scene, Levels) else scene


def as_levels(scene: Gaussians | Levels) -> Levels:
    """A scene without levels is one level.

    Raises:
        ValueError: If it is empty.
    """
    return scene if isinstance(scene, Levels) else Levels.single(scene)


def level_scenes(levels: Levels) -> Iterator[tuple[Gaussians, I64]]:
    """Each level as a scene of its own, lowest first, and the (n,) rising ids of its Gaussians in the union."""
    for k in range(len(levels)):
        ids = np.flatnonzero(levels.member(k))
        yield (levels.union if len(ids) == len(levels.union) else levels.union[ids]), ids


def levels_record(scene: Gaussians | Levels) -> dict[str, Any] | None:
    """Names, counts and a hash of who belongs where, as JSON keeps them; None for a scene or a single level."""
    if not isinstance(scene, Levels) or len(scene) == 1:
        return None
    membership = hashlib.sha256(b"gsvis levels 1\n" + scene.first.tobytes() + scene.last.tobytes()).hexdigest()
    return {"names": list(scene.names), "counts": list(scene.counts), "membership": membership}


def joined(views: Sequence[CellView], ids: Sequence[I64], count: int) -> CellView:
    """What a cell sees of a union.

    Args:
        views: What it sees of each level.
        ids: The Gaussians of each level in the union.
        count: N of the union.

    Returns:
        The Gaussians that some level shows, with the class of their largest weight and all directions; viewpoints and
        growth are those of the level that was looked at for longest.
    """
    if len(views) == 1:
        return views[0]
    best = np.full(count, -1, np.int16)
    sets = np.zeros((count, NUM_FACES // 8), np.uint8)
    for view, places in zip(views, ids, strict=True):
        rows = places[view.ids]
        best[rows] = np.maximum(best[rows], view.classes)
        sets[rows] |= view.directions
    found = np.flatnonzero(best >= 0)
    longest = max(views, key=lambda view: (view.viewpoints, view.growth))
    return CellView(
        found.astype(np.int32), best[found].astype(np.uint8), sets[found], longest.viewpoints, longest.growth
    )
