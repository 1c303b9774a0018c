"""Find the eyes that stand within the walls of a scene, if most of its detail is seen from there.

A wall of Gaussians looks the same from behind as from the room, so a free line of sight to detail does not prove that
somebody could stand at its end. Frame and units are the scene's own; nothing here depends on navigable space.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from gsvis.scene.cameras import Cameras

__all__ = ["LEAST", "Enclosure"]

F64 = NDArray[np.float64]
Bool = NDArray[np.bool_]
Look = Callable[[Cameras], tuple[NDArray[np.float32], NDArray[np.float32]]]

LEAST = 8
"""Eyes from which there is an answer."""

_SIDE = 8  # pixels along a side of the six images around an eye
_FILLED = 0.5  # alpha from which a pixel shows something
_NEAR = 2.0  # radii of the core within which it stands around an eye
_SHARE = 0.75  # of the directions around an eye: a wall or the ground is half of them
_MOST = 0.5  # share of the eyes that stand within walls, at least: fewer are in hollow objects, or in bushes
_TIMES = 2.0  # as much detail that eyes within walls have to see
_EYES = 16  # of each kind whose detail is compared, at most
_POINTS = 3000  # of the detail that are compared
_CLOSE = 1.0 / 16.0  # radii of the core: farther from what is seen, a point of detail is not seen


class Enclosure:
    """The walls around the eyes of a scene.

    Args:
        look: Function from cameras to their alphas (C, H, W) and depths (C, H, W).
        points: (P, 3) points of the detail.
        radius: Radius of the core of the scene.
        axes: (3, 3) axes that rotate with the scene, one per row, so that the result does not depend on the frame.
    """

    def __init__(self, look: Look, points: F64, radius: float, axes: F64) -> None:
        self._look = look
        self._points = points[:: max(1, len(points) // _POINTS)]
        self._radius = radius
        self._axes = axes

    def holds(self, eyes: F64) -> Bool:
        """Return which eyes (E, 3) have something near in most directions, (E,) bool."""
        return self._around(eyes)[0] >= _SHARE

    def choose(self, eyes: F64) -> Bool | None:
        """Return which eyes stand within walls, if these see much more of the detail than the other eyes.

        Args:
            eyes: (E, 3) eyes, some maybe behind walls.

        Returns:
            (E,) bool; None if it makes no difference, or for fewer than `LEAST` eyes.
        """
        if len(eyes) < LEAST:
            return None
        shares, seen = self._around(eyes)
        within = shares >= _SHARE
        if within.all() or within.mean() < _MOST:
            return None
        many = min(_EYES, np.count_nonzero(~within))
        inside = self._detail([seen[k] for k in np.flatnonzero(within)[:many]])
        outside = self._detail([seen[k] for k in np.flatnonzero(~within)[:many]])
        return within if inside > 0.0 and inside >= _TIMES * outside else None

    def _around(self, eyes: F64) -> tuple[F64, list[F64]]:
        """Return the share of the sphere in which something is near each eye, and the points (S, 3) seen there."""
        if len(eyes) == 0:
            return np.zeros(0), []
        cameras = _cube_cameras(eyes, self._axes)
        alphas, depths = self._look(cameras)
        center = (np.arange(_SIDE) + 0.5) / _SIDE * 2.0 - 1.0
        x, y = np.meshgrid(center, center)
        rays = np.stack([x, y, np.ones_like(x)], axis=-1)
        length = np.linalg.norm(rays, axis=-1)
        stopped = (alphas >= _FILLED) & (depths * length < _NEAR * self._radius)
        angle = length**-3.0  # solid angle of a pixel, up to a constant factor
        shares = (stopped * angle).sum(axis=(1, 2)).reshape(len(eyes), 6).sum(axis=1) / (6.0 * angle.sum())
        turn = cameras.viewmats[:, :3, :3]  # from the scene's axes to those of an image
        away = np.einsum("cij,hwi->chwj", turn, rays) * depths[..., None]
        places = (away + np.repeat(eyes, 6, axis=0)[:, None, None]).reshape(len(eyes), -1, 3)
        there = stopped.reshape(len(eyes), -1)
        return shares, [places[k][there[k]] for k in range(len(eyes))]

    def _detail(self, seen: list[F64]) -> float:
        """Return the share of the detail that lies near points that eyes see; each item is (S, 3)."""
        from scipy.spatial import cKDTree  # slow to import, and seldom needed

        tree = cKDTree(np.concatenate(seen))
        apart, _ = tree.query(self._points, distance_upper_bound=_CLOSE * self._radius)
        return float(np.isfinite(apart).mean())


def _cube_cameras(eyes: F64, axes: F64) -> Cameras:
    """Return six square cameras around each eye, along axes (3, 3)."""
    ahead = np.concatenate([axes, -axes])
    up = np.roll(axes, 1, axis=0)
    targets = (eyes[:, None] + ahead).reshape(-1, 3)
    places = np.repeat(eyes, 6, axis=0)
    cameras = [
        Cameras.look_at(places[k::6], targets[k::6], up=up[k % 3], width=_SIDE, height=_SIDE, fov=90.0)
        for k in range(6)
    ]
    order = np.argsort(np.tile(np.arange(len(eyes)), 6), kind="stable")
    poses = np.concatenate([each.viewmats for each in cameras])[order]
    return Cameras(poses, np.tile(cameras[0].Ks[:1], (len(poses), 1, 1)), _SIDE, _SIDE)
