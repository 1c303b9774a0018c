"""Convert positions that a user gives to the frame of a scene: they may be in the coordinates of its source.

A scene with an origin lies far from (0, 0, 0) of its source, so positions are near the scene in only one of the two
frames. Double precision throughout.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.paths import HeadPath

__all__ = ["SourceFrame"]

F64 = NDArray[np.float64]

_ASKED = 5_000  # centers that give the middle


@dataclass(frozen=True, eq=False)
class SourceFrame:
    """The place of a scene in the coordinates of its source.

    Attributes:
        origin: (3,) the scene's (0, 0, 0), in the coordinates of its source.
        middle: (3,) a point in the middle of its content, scene frame.
    """

    origin: F64
    middle: F64

    @classmethod
    def from_scene(cls, g: Gaussians) -> SourceFrame:
        """Return the frame of a scene."""
        some = g.means[:: max(1, len(g) // _ASKED)].astype(np.float64)
        middle = np.median(some, axis=0) if len(some) else np.zeros(3)
        return cls(np.asarray(g.facts.origin, np.float64), middle)

    def points(self, points: ArrayLike) -> F64:
        """Return (P, 3) positions in the scene's frame.

        Args:
            points: (P, 3) positions, all in the scene's frame or all in the coordinates of its source; the frame in
                which they are nearer to the scene is chosen.
        """
        given = _check.floats("points", points, ("P", 3), np.float64)
        return given - self.origin if self._is_of_source(given) else given

    def walk(self, walk: HeadPath) -> HeadPath:
        """Return a walk in the scene's frame; see `points`."""
        return replace(walk, positions=self.points(walk.positions)) if self.origin.any() else walk

    def cameras(self, cameras: Cameras) -> Cameras:
        """Return cameras in the scene's frame; see `points`."""
        return cameras.with_origin(self.origin) if self._is_of_source(cameras.viewpoints) else cameras

    def _is_of_source(self, points: F64) -> bool:
        """Return whether (P, 3) positions are in the coordinates of the source: the scene lies nearer to them there."""
        if not self.origin.any() or len(points) == 0:
            return False
        away = np.median(points, axis=0) - self.middle
        return bool(np.linalg.norm(away - self.origin) < np.linalg.norm(away))
