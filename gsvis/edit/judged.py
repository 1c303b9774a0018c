"""Compare a scene before and after a cleaning, at builder's eyes in navigable space and at judge's eyes.

Images are small, with base colors, of a thinned scene; they show missing parts in a tenth of the time of full images.
If an image shows no removed Gaussian, both versions are equal and are not rendered.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsvis._kernels.threads import one_thread
from gsvis.edit.guard import PSNR_CAP
from gsvis.progress import Progress, silent
from gsvis.pvs.cells import CellGrid
from gsvis.render import psnr, rasterize
from gsvis.render.judges import judging_views
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.judged import Judged
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.thinned import thin
from gsvis.scene.view_sampling import ViewSampling

__all__ = ["judge_cleaning"]

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

_MOST = 12_000  # Gaussians that are drawn
_STAGE = "judge"


def judge_cleaning(
    g: Gaussians,
    kept: NDArray[np.bool_],
    core: Gaussians,
    views: ViewSampling,
    navigable: NavigableSpace,
    *,
    progress: Progress = silent,
) -> Judged:
    """Return the quality at builder's and judge's eyes of a scene of which only some Gaussians are kept.

    Args:
        g: The scene, N Gaussians.
        kept: (N,) True for Gaussians that stay.
        core: Gaussians that form its surfaces; no eye lies inside of them.
        views: Number of views at each kind of eyes, size, field of view and seed.
        navigable: Allowed viewpoints.
        progress: Called with stage "judge".
    """
    progress(_STAGE, 0, 1)
    with one_thread():
        mine, judges = judging_views(g, views, navigable, whole=core)
        ids, few = thin(g, _MOST, seed=views.seed)
        ours, theirs = (_compare(few, kept[ids], cameras) for cameras in (mine, judges.cameras))
    progress(_STAGE, 1, 1)
    eyes = judges.cameras.viewpoints
    inside = CellGrid.over(navigable).cell_at(eyes) >= 0 if len(eyes) else np.zeros(0, bool)
    return Judged(ours, theirs, inside, judges.named, judges.given)


def _compare(g: Gaussians, kept: Mask, cameras: Cameras) -> F64:
    """Return (C,) the PSNR of views of the kept Gaussians against the whole scene."""
    found = np.full(len(cameras), PSNR_CAP)
    if kept.all() or len(cameras) == 0:
        return found
    gone = rasterize(g[~kept], cameras, backend="cpu").alphas  # without occlusion
    some = np.flatnonzero(gone.any(axis=(1, 2)))
    if len(some):
        whole, part = (np.clip(rasterize(each, cameras[some], backend="cpu").images, 0.0, 1.0) for each in (g, g[kept]))
        found[some] = np.minimum(np.atleast_1d(psnr(part, whole)), PSNR_CAP)
    return found
