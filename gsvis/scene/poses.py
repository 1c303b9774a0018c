"""Convert cameras to and from the poses in manifests and pages. Scene frame; OpenCV axes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from gsvis.scene.cameras import Cameras, intrinsics
from gsvis.scene.gaussians import quats_from_rotations, rotations_from_quats

__all__ = ["cameras_from_poses", "decimals_of", "describe_poses"]


def cameras_from_poses(poses: Sequence[Mapping[str, Any]], width: int, height: int, fov: float) -> Cameras:
    """Return cameras at poses that `describe_poses` returned.

    Args:
        poses: C poses with `position` (3,) and `rotation` (4,) wxyz, world from camera.
        width: Pixels.
        height: Pixels.
        fov: Horizontal field of view, degrees.

    Raises:
        ValueError: If a pose is not rigid.
    """
    quats = np.array([pose["rotation"] for pose in poses], np.float64).reshape(-1, 4)
    eyes = np.array([pose["position"] for pose in poses], np.float64).reshape(-1, 3)
    quats = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    viewmats = np.tile(np.eye(4), (len(poses), 1, 1))
    viewmats[:, :3, :3] = np.swapaxes(rotations_from_quats(quats), 1, 2)
    viewmats[:, :3, 3] = -np.einsum("cij,cj->ci", viewmats[:, :3, :3], eyes)
    return Cameras(viewmats, np.tile(intrinsics(width, height, fov), (len(poses), 1, 1)), width, height)


def decimals_of(lengths: ArrayLike, decimals: int = 6) -> int:
    """Return the number of decimals for lengths: more if all are below 1, as in scenes with small units.

    Examples:
        >>> decimals_of([3.0, 0.1]), decimals_of([2e-3])
        (6, 9)
    """
    most = float(np.abs(np.asarray(lengths, np.float64)).max(initial=0.0))
    return decimals if not 0.0 < most < 1.0 else decimals - math.floor(math.log10(most))


def describe_poses(cameras: Cameras | None, *, decimals: int | None = 6) -> list[dict[str, Any]]:
    """Return `position` (3,) and `rotation` (4,) wxyz, world from camera, of each camera, ready for JSON.

    Args:
        cameras: The cameras; None gives an empty list.
        decimals: Decimals, more for positions in small units; None keeps all.

    Examples:
        >>> describe_poses(Cameras.look_at([(1, 0, 0)], [(1, 0, 5)], up=(0, -1, 0)))
        [{'position': [1.0, 0.0, 0.0], 'rotation': [1.0, 0.0, 0.0, 0.0]}]
    """
    if cameras is None:
        return []
    quats = quats_from_rotations(cameras.viewmats[:, :3, :3].transpose(0, 2, 1))
    if decimals is not None:
        digits = decimals
        places = decimals_of(cameras.viewpoints, decimals)
        return [
            {"position": [round(v, places) + 0.0 for v in eye], "rotation": [round(v, digits) + 0.0 for v in quat]}
            for eye, quat in zip(cameras.viewpoints.tolist(), quats.tolist(), strict=True)
        ]
    return [
        {"position": eye, "rotation": quat}
        for eye, quat in zip(cameras.viewpoints.tolist(), quats.tolist(), strict=True)
    ]
