"""Poses of cameras as manifests and pages hold them. Scene frame; OpenCV axes (+x right, +y down, +z forward)."""

from __future__ import annotations

from typing import Any

from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import quats_from_rotations

__all__ = ["describe_poses"]


def describe_poses(cameras: Cameras | None) -> list[dict[str, Any]]:
    """Return `position` (3,) and `rotation` (4,) wxyz, world from camera, of each camera, ready for JSON; none of None.

    Examples:
        >>> describe_poses(Cameras.look_at([(1, 0, 0)], [(1, 0, 5)], up=(0, -1, 0)))
        [{'position': [1.0, 0.0, 0.0], 'rotation': [1.0, 0.0, 0.0, 0.0]}]
    """
    if cameras is None:
        return []
    quats = quats_from_rotations(cameras.viewmats[:, :3, :3].transpose(0, 2, 1))
    return [
        {"position": [round(float(v), 6) + 0.0 for v in eye], "rotation": [round(float(v), 6) + 0.0 for v in quat]}
        for eye, quat in zip(cameras.viewpoints, quats, strict=True)
    ]
