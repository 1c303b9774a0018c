"""How much each Gaussian counts in images, and from which directions: gathered from views, for the fit of colors.

A view adds, for each Gaussian, the sum over its pixels of the squared blending weight: times the squared error of the
Gaussian's color, that is what the error adds to the squared error of the image, other Gaussians being right. Of levels
each is drawn by itself, and a Gaussian counts what it counts on average in those that have it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis.progress import Progress, silent
from gsvis.raycast.directions import NUM_FACES, face_of
from gsvis.render.weights import view_weights
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels, as_levels, level_scenes, union_of

__all__ = ["ViewImportance", "importance_from_views"]

_FLOOR = 1e-4


@dataclass(frozen=True, eq=False)
class ViewImportance:
    """What views say of N Gaussians.

    Attributes:
        faces: (N, 80) float32, summed squared weights from the directions of each face (Gaussian to eye), over the
            number of pixels of all views; the mean over the levels that have the Gaussian.
    """

    faces: NDArray[np.float32]

    @property
    def sets(self) -> NDArray[np.uint8]:
        """(N, 10) direction sets: the faces from which any view has seen the Gaussian."""
        return np.packbits(self.faces > 0, axis=1, bitorder="little")

    @property
    def importance(self) -> NDArray[np.float64]:
        """(N,) what the mean squared error of an image grows by for a squared error of 1, plus a small floor.

        The floor, 1e-4 of the mean, is for what no view happened to see.
        """
        summed = self.faces.sum(axis=1, dtype=np.float64)
        floor = _FLOOR * float(summed.mean()) if len(summed) else 0.0
        return np.asarray(summed + floor)


def importance_from_views(g: Gaussians | Levels, cameras: Cameras, *, progress: Progress = silent) -> ViewImportance:
    """Squared blending weights of each Gaussian over views, by the face it is seen from.

    The squared weights of a view are bounded by the sum of its weights times the largest. The mean over the levels
    that have a Gaussian is what its color brings for each time that it is sent to someone who stays at one level.

    Args:
        g: N Gaussians; or levels of which N are the union.
        cameras: Any number; one is held in memory at a time.
        progress: Called with stage "importance", in views of a level.

    Returns:
        The sums over all views.
    """
    faces = np.zeros((len(union_of(g)), NUM_FACES), np.float32)
    if len(faces) == 0:
        return ViewImportance(faces)
    levels = as_levels(g)
    pixels, looks = len(cameras) * cameras.width * cameras.height, len(cameras) * len(levels)
    progress("importance", 0, looks)
    for k, (scene, places) in enumerate(level_scenes(levels)):
        for c in range(len(cameras)):
            seen = view_weights(scene, cameras[c])
            squared = seen.summed[0] * seen.largest[0]
            ids = np.flatnonzero(squared)
            towards_eye = cameras[c].viewpoints - scene.means[ids].astype(np.float64)
            away = np.linalg.norm(towards_eye, axis=1)
            ids, towards_eye = ids[away > 0], towards_eye[away > 0] / away[away > 0, None]
            faces[places[ids], face_of(towards_eye)] += squared[ids] / np.float32(pixels)
            progress("importance", k * len(cameras) + c + 1, looks)
    faces /= (levels.last - levels.first + np.uint8(1))[:, None]
    return ViewImportance(faces)
