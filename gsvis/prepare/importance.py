"""Compute the importance of each Gaussian in images, and the directions that see it, for the fit of colors.

Each view adds, for each Gaussian, the sum of its squared blending weights over pixels. This sum, times the squared
error of the Gaussian's color, is the squared error of the image if all other colors are exact. Each level is drawn
alone. The importance of a Gaussian is the mean over the levels that have it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis.prepare._kernels import importance as kernels
from gsvis.progress import Progress, silent
from gsvis.raycast.directions import NUM_FACES, face_planes
from gsvis.render.weights import view_weights
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels, as_levels, level_scenes, union_of

__all__ = ["ViewImportance", "direction_weights", "importance_from_views"]

_FLOOR = 1e-4
_PART = 1 << 16  # Gaussians at a time
_EVEN = 0.7  # share of a color's weight that is the same for all directions of its set; the rest follows the views
_OUTSIDE = 0.003  # weight of a direction outside the set; a color that nothing bounds there can be far off


@dataclass(frozen=True, eq=False)
class ViewImportance:
    """The importance of N Gaussians by direction.

    Attributes:
        faces: (N, 80) float32, sum of squared weights for the directions of each face (Gaussian to eye), over the
            number of pixels of all views; mean over the levels that have the Gaussian.
    """

    faces: NDArray[np.float32]

    @property
    def sets(self) -> NDArray[np.uint8]:
        """(N, 10) uint8 direction sets: the faces from which any view sees the Gaussian."""
        return _by_parts(self.faces, lambda faces: np.packbits(faces > 0, axis=1, bitorder="little"))

    @property
    def shares(self) -> NDArray[np.uint8]:
        """(N, 80) share of each face in the sum over all faces, 255 for all of it; zeros for a Gaussian never seen."""

        def share(faces: NDArray[np.float32]) -> NDArray[np.uint8]:
            """Return the shares of some rows."""
            summed = np.maximum(faces.sum(axis=1), np.float32(1e-30))
            return np.asarray(np.rint(faces * (255.0 / summed)[:, None]), np.uint8)

        return _by_parts(self.faces, share)

    @property
    def importance(self) -> NDArray[np.float64]:
        """(N,) growth of an image's mean squared error for a squared color error of 1, plus a small floor.

        The floor is 1e-4 of the mean. It serves Gaussians that no view sees.
        """
        summed = self.faces.sum(axis=1, dtype=np.float64)
        floor = _FLOOR * float(summed.mean()) if len(summed) else 0.0
        return np.asarray(summed + floor)


def _by_parts(faces: NDArray[np.float32], of: Callable[[NDArray[np.float32]], NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """Return what a function returns for all rows, called for some at a time to bound memory."""
    return np.concatenate([of(faces[start : start + _PART]) for start in range(0, max(len(faces), 1), _PART)])


def direction_weights(sets: NDArray[np.uint8], shares: NDArray[np.uint8] | None) -> NDArray[np.float32]:
    """Return (N, 80) weights of the faces in the fit of each color.

    Most of the weight is the same for all directions of a set. The rest is proportional to the image area seen from
    each direction, so that errors fall where few views look. A small part lies outside the set, because a view between
    the rendered ones may look from there.

    Args:
        sets: (N, 10) uint8 direction sets.
        shares: `ViewImportance.shares`, or None to weigh all directions of a set the same.
    """
    inside = np.unpackbits(sets, axis=1, bitorder="little")
    weights = np.maximum(inside, np.float32(_OUTSIDE), dtype=np.float32)
    if shares is not None:
        seen = shares.any(axis=1)
        total = shares[seen].sum(axis=1, dtype=np.float32)
        weights[seen] *= _EVEN
        counts = inside[seen].sum(axis=1, dtype=np.float32)
        weights[seen] += shares[seen] * ((1.0 - _EVEN) * counts / total)[:, None].astype(np.float32)
    weights[~inside.any(axis=1)] = 0.0
    return np.asarray(weights, np.float32)


def importance_from_views(g: Gaussians | Levels, cameras: Cameras, *, progress: Progress = silent) -> ViewImportance:
    """Sum squared blending weights of each Gaussian over views, by the face that it is seen from.

    For each view, the upper bound (sum of weights) x (largest weight) replaces the sum of squared weights. The mean
    over the levels that have a Gaussian is the benefit of its color for a viewer who stays at one level.

    Args:
        g: N Gaussians; or levels with a union of N.
        cameras: Any number of cameras; memory holds the weights of one view at a time.
        progress: Called with stage "importance"; counts each view once for each level.

    Returns:
        The sums over all views.
    """
    faces = np.zeros((len(union_of(g)), NUM_FACES), np.float32)
    if len(faces) == 0:
        return ViewImportance(faces)
    levels = _without_harmonics(as_levels(g))
    pixels = np.float32(len(cameras) * cameras.width * cameras.height)
    planes = face_planes()
    looks = len(cameras) * len(levels)
    progress("importance", 0, looks)
    for k, (scene, places) in enumerate(level_scenes(levels)):
        for c in range(len(cameras)):
            seen = view_weights(scene, cameras[c])
            eye = cameras[c].viewpoints[0]
            weights = seen.largest[0], seen.summed[0]
            kernels.add_squares(places, scene.means, *weights, eye, pixels, *planes, faces)
            progress("importance", k * len(cameras) + c + 1, looks)
    faces /= (levels.last - levels.first + np.uint8(1))[:, None]
    return ViewImportance(faces)


def _without_harmonics(levels: Levels) -> Levels:
    """Return the same levels without SH above degree 0, so that the scene of a level holds little."""
    return Levels(levels.union.without_harmonics(), levels.first, levels.last, levels.names)
