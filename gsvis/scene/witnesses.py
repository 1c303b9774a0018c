"""Keep a part of the cameras or of a walk as witnesses, which are not used to find navigable space."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis.scene.cameras import Cameras, intrinsics

__all__ = ["Witnesses", "hold_out"]

_FROM = 16  # cameras from which half of them can be spared


@dataclass(frozen=True, eq=False)
class Witnesses:
    """Poses of people in the scene that judge results made without them.

    Attributes:
        cameras: The poses; their sizes and fields of view do not matter.
        named: Their source, in words.
    """

    cameras: Cameras
    named: str

    @property
    def digest(self) -> str:
        """Hash of the poses, 64 hexadecimal digits."""
        return hashlib.sha256(np.ascontiguousarray(self.cameras.viewmats, "<f8").tobytes()).hexdigest()

    def views(self, count: int, width: int, height: int, fov: float) -> Cameras:
        """Return `count` of the poses, evenly spaced, as cameras of one size; all if there are fewer."""
        chosen = np.floor(np.arange(min(count, len(self.cameras))) * (len(self.cameras) / max(count, 1))).astype(int)
        if count >= len(self.cameras):
            chosen = np.arange(len(self.cameras))
        poses = self.cameras.viewmats[chosen]
        return Cameras(poses, np.tile(intrinsics(width, height, fov), (len(poses), 1, 1)), width, height)


def hold_out(count: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return which poses may be used to find something, and which are kept to judge it: every other one.

    With fewer than 16 poses, none is kept.
    """
    every = np.arange(count)
    return (every, every[:0]) if count < _FROM else (every[::2], every[1::2])
