"""Find cameras that see nothing of a scene, which shows that their frame is wrong.

A coarse test of Gaussians against the frustum of a camera, without rays or rendering. It tests only whether a camera
looks at the scene at all. Scene frame; OpenCV cameras; no absolute length.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians

__all__ = ["blind"]

F64 = NDArray[np.float64]

_MOST = 100_000  # Gaussians looked at, at even steps
_VISIBLE = 1.0 / 255.0
_SPECK = 0.05  # of the picture's longer side: a scene that is smaller in it is only a speck
_GIANT = 0.5  # reach over the scene's size: skies and veils show nothing of the frame


def blind(g: Gaussians, cameras: Cameras) -> NDArray[np.bool_]:
    """Return whether each camera sees nothing of a scene, or only a speck in the distance.

    Args:
        g: N Gaussians.
        cameras: C cameras.

    Returns:
        (C,) True if no Gaussian reaches into the image, or if the whole scene is a speck in it.
    """
    means, reach = _balls(g)
    found = np.ones(len(cameras), bool)
    if len(means) == 0:
        return found
    for index in range(len(cameras)):
        pose = cameras.viewmats[index]
        k = cameras.Ks[index]
        points = means @ pose[:3, :3].T + pose[:3, 3]
        inside = points[:, 2] > 0.0
        for axis, side in enumerate((cameras.width, cameras.height)):
            slopes = (0.0 - k[axis, 2]) / k[axis, axis], (side - k[axis, 2]) / k[axis, axis]
            for slope, sign in zip(slopes, (1.0, -1.0), strict=True):
                off = sign * (points[:, axis] - slope * points[:, 2]) / np.hypot(1.0, slope)
                inside &= off > -reach
        found[index] = not inside.any() or _is_speck(points, k, max(cameras.width, cameras.height))
    return found


def _balls(g: Gaussians) -> tuple[F64, F64]:
    """Return centers (M, 3) and reaches (M,) of a sample of Gaussians, without giants."""
    some = slice(None, None, max(1, -(-len(g) // _MOST)))
    means = g.means[some].astype(np.float64)
    opacities = g.opacities[some].astype(np.float64)
    reach = np.sqrt(2.0 * np.log(np.maximum(opacities / _VISIBLE, 1.0))) * g.scales[some].max(axis=1)
    kept = opacities >= _VISIBLE
    if kept.any():
        low, high = np.quantile(means[kept], [0.05, 0.95], axis=0)
        size = float(np.linalg.norm(high - low))
        if size > 0.0:
            within = np.all((means >= low - 2.0 * size) & (means <= high + 2.0 * size), axis=1)
            shown = kept & within & (reach <= _GIANT * size)
            kept = shown if shown.any() else kept
    return means[kept], reach[kept]


def _is_speck(points: F64, k: F64, side: int) -> bool:
    """Return whether 90% of the centers lie in front of a camera and within a small part of its image."""
    ahead = points[points[:, 2] > 0.0]
    if len(ahead) < 0.9 * len(points) or len(points) < 2:
        return False
    pixels = ahead[:, :2] / ahead[:, 2:] * k[[0, 1], [0, 1]]
    low, high = np.quantile(pixels, [0.05, 0.95], axis=0)
    return float((high - low).max()) < _SPECK * side
