"""Find the up axis from cameras: people hold them level, so their horizontal axes lie in one plane.

Scene frame. This module knows no Gaussian.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gsvis.scene.cameras import Cameras

__all__ = ["Level", "level_cameras"]

F64 = NDArray[np.float64]

_ROLL = 6.0  # degrees of roll with which people hold a camera
_LOOSE = 25.0  # degrees of roll at which cameras say little
_TURNED = 0.02  # least mean square across the plane's second axis: cameras that all look one way have no plane
_STEPS = 10


class Level(NamedTuple):
    """The up axis of cameras.

    Attributes:
        up: (3,) unit vector, scene frame.
        confidence: In (0, 1].
        reason: The reason, in a line.
    """

    up: F64
    confidence: float
    reason: str


def level_cameras(cameras: Cameras) -> Level | None:
    """Return the up axis of cameras, or None if there are none.

    The result is the direction most orthogonal to the horizontal axis of every camera; for a camera held in portrait,
    that is its y axis. Its sign points to the top of the images.

    Args:
        cameras: The cameras.
    """
    count = len(cameras.viewmats)
    if count == 0:
        return None
    right, down, ahead = (cameras.viewmats[:, row, :3] for row in range(3))
    top = -down.mean(axis=0)
    found = _fit(right, down)
    if found is None:  # all look one way: only the top of the images is known
        length = float(np.linalg.norm(top))
        if length < 0.5:
            return None
        return Level(top / length, 0.6 * length, f"{count} cameras that look one way")
    up, roll = found
    upward = float(top @ up)
    sign = upward if abs(upward) > 0.1 else -float(ahead.mean(axis=0) @ up)  # people look down rather than up
    up = up if sign >= 0.0 else -up
    clear = min(1.0, 0.5 + abs(upward)) if abs(upward) > 0.1 else 0.6
    confidence = 0.98 * clear * float(np.exp(-0.5 * (roll / _LOOSE) ** 2)) * count / (count + 0.5)
    return Level(up, confidence, f"{count} cameras are held level to {roll:.1f} degrees")


def _fit(right: F64, down: F64) -> tuple[F64, float] | None:
    """Return the axis most orthogonal to one image axis of each camera, and their roll in degrees.

    None if these axes do not span a plane.
    """
    level = right
    weights = np.ones(len(right))
    up = np.zeros(3)
    for _ in range(_STEPS):
        sizes, axes = np.linalg.eigh((level.T * weights) @ level / weights.sum())
        if sizes[1] < _TURNED:
            return None
        up = axes[:, 0]
        level = np.where((np.abs(right @ up) <= np.abs(down @ up))[:, None], right, down)
        weights = 1.0 / (np.sin(np.radians(_ROLL)) ** 2 + (level @ up) ** 2)
    roll = float(np.degrees(np.arcsin(np.clip(np.sqrt(np.median((level @ up) ** 2)), 0.0, 1.0))))
    return up, roll
