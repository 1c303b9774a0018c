"""Keep a part of the cameras or of a walk as judges: those that navigable space was not found by."""

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
    """Poses of people who stood in the scene, which judge what was made without them.

    Attributes:
        cameras: The poses; their sizes and fields of view do not matter.
        named: What they are, in words.
    """

    cameras: Cameras
    named: str

    @property
    def digest(self) -> str:
        """Hash of the poses, 64 hexadecimal digits."""
        return hashlib.sha256(np.ascontiguousarray(self.cameras.viewmats, "<f8").tobytes()).hexdigest()

    def views(self, count: int, width: int, height: int, fov: float) -> Cameras:
        """Return `count` of the poses, evenly spaced, as cameras of one size; all if there are no more."""
        chosen = np.floor(np.arange(min(count, len(self.cameras))) * (len(self.cameras) / max(count, 1))).astype(int)
        if count >= len(self.cameras):
            chosen = np.arange(len(self.cameras))
        poses = self.cameras.viewmats[chosen]
        return Cameras(poses, np.tile(intrinsics(width, height, fov), (len(poses), 1, 1)), width, height)


def hold_out(count: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return which of some poses may be used to find something, and which are kept to judge it: every other one.

    Of fewer than 16 none is kept: each is needed.
    """
    every = np.arange(count)
    return (every, every[:0]) if count < _FROM else (every[::2], every[1::2])
