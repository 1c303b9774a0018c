"""Choose start views for visitors: upright, from where a person may stand, and with much to see.

Cameras are drawn at random where eyes may be. A view is worth as many Gaussians as contribute to its pixels, so one
into a near wall is worth little. Scene frame; OpenCV cameras.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gsvis.errors import SceneError
from gsvis.render import view_weights
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.view_sampling import ViewSampling

__all__ = ["START_VIEWS", "choose_start_views"]

F64 = NDArray[np.float64]

START_VIEWS = 5
"""Number of views of a package."""

_SAMPLING = ViewSampling(48, 96, 72, 80.0, stream=4)
_LEVEL = 0.35  # greatest slope of a view, as the sine of its angle with the ground
_STANDING = (0.35, 0.75)  # height of an eye between floor and ceiling
_SEEN = 0.25  # least summed weight, pixels, of a Gaussian that counts
_APART = 0.1  # least distance between the eyes of two views, in the diagonal of all


def choose_start_views(
    scene: Gaussians, space: NavigableSpace, count: int = START_VIEWS, *, drawn: int = 48, seed: int = 0
) -> Cameras | None:
    """Return the views of a scene that show most, the best first; None if none is found.

    Args:
        scene: The scene.
        space: Allowed viewpoints.
        count: Largest number of views.
        drawn: Number of cameras to choose from.
        seed: Seed of the random numbers.
    """
    try:
        cameras = replace(_SAMPLING, count=drawn, seed=seed).cameras(scene, space)
    except SceneError:
        return None
    eyes = cameras.viewpoints
    fitting = _is_standing(eyes, space) & (np.abs(cameras.forwards @ space.up) <= _LEVEL)
    some = np.flatnonzero(fitting) if fitting.any() else np.arange(len(cameras))
    worth = [int(np.count_nonzero(view_weights(scene, cameras[c]).summed[0] >= _SEEN)) for c in some.tolist()]
    apart = _APART * float(np.linalg.norm(np.ptp(eyes, axis=0)))
    chosen: list[int] = []
    for k in some[np.argsort(-np.array(worth), kind="stable")].tolist():
        if len(chosen) < count and all(np.linalg.norm(eyes[k] - eyes[other]) >= apart for other in chosen):
            chosen.append(k)
    return cameras[chosen]


def _is_standing(eyes: F64, space: NavigableSpace) -> NDArray[np.bool_]:
    """Return whether each eye is at the height of a standing person, where there are a floor and a ceiling."""
    below, above = (space.free_distances(eyes, np.tile(way, (len(eyes), 1))) for way in (-space.up, space.up))
    roofed = np.isfinite(below + above)
    share = np.full(len(eyes), 0.5)
    share[roofed] = below[roofed] / (below + above)[roofed]
    return (share >= _STANDING[0]) & (share <= _STANDING[1])
