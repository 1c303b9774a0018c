"""Where a viewer of a static scene may begin: a pose in its cells, or one outside of a scene that has none."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis.pvs.cells import CellGrid
from gsvis.scene.gaussians import quats_from_rotations

__all__ = ["Start", "start_poses"]

F64 = NDArray[np.float64]


@dataclass(frozen=True)
class Start:
    """A pose to begin with.

    Attributes:
        position: (3,) scene frame.
        rotation: (4,) wxyz, world from camera, OpenCV axes.
    """

    position: tuple[float, float, float]
    rotation: tuple[float, float, float, float]

    def as_dict(self) -> dict[str, Any]:
        """Return both, ready for JSON."""
        return {"position": list(self.position), "rotation": list(self.rotation)}

    @classmethod
    def from_dict(cls, view: dict[str, list[float]]) -> Start:
        """Return a view of a package; see `Manifest.views`."""
        x, y, z = view["position"]
        a, b, c, d = view["rotation"]
        return cls((x, y, z), (a, b, c, d))

    @classmethod
    def looking(cls, eye: ArrayLike, target: ArrayLike, up: ArrayLike) -> Start:
        """Return the pose of an eye that looks at a target; the image stands upright."""
        at, above = np.asarray(eye, np.float64), np.asarray(up, np.float64)
        forward = np.asarray(target, np.float64) - at
        forward = forward / max(float(np.linalg.norm(forward)), 1e-12)
        right = np.cross(forward, above)
        if np.linalg.norm(right) < 1e-6:  # it looks along up: any upright image will do
            right = np.cross(forward, np.roll(above, 1) + 1e-3)
        right = right / np.linalg.norm(right)
        turn = np.stack([right, np.cross(forward, right), forward], axis=1)
        w, x, y, z = (round(v, 6) for v in quats_from_rotations(turn[None])[0].tolist())
        a, b, c = (round(v, 6) for v in at.tolist())
        return cls((a, b, c), (w, x, y, z))


def start_poses(bounds: F64, grid: CellGrid | None, up: ArrayLike) -> tuple[Start, ...]:
    """Return poses to begin with.

    Args:
        bounds: (2, 3) corners of a box around the middle of the scene.
        grid: Its cells; the eye is in the middle of them and looks along the longest way. None puts the eye outside.
        up: (3,) unit axis that points upwards.
    """
    above = np.asarray(up, np.float64) / np.linalg.norm(up)
    if grid is None:
        middle, size = bounds.mean(axis=0), float(np.linalg.norm(bounds[1] - bounds[0]))
        side = np.roll(np.abs(above), 1) - np.roll(np.abs(above), 2)
        return (Start.looking(middle + (0.9 * side / np.linalg.norm(side) + 0.3 * above) * size, middle, above),)
    centers = grid.centers
    eye = centers[np.linalg.norm(centers - centers.mean(axis=0), axis=1).argmin()]
    away = centers - eye
    away = away - np.outer(away @ above, above)
    far = away[np.linalg.norm(away, axis=1).argmax()]
    if np.linalg.norm(far) < 1e-9:
        far = np.roll(above, 1)
    return (Start.looking(eye, eye + far, above), Start.looking(eye, eye - far, above))
