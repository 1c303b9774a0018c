"""Thin a scene for small images: fewer Gaussians, widened to represent those that were dropped.

Large Gaussians are kept unchanged. Of small ones a random sample is kept and widened to the area of all. The result
follows rotation, translation and scale of the scene, and does not depend on the order of its Gaussians. It suits coarse
images, but not their texture.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.scene.drawn_by_content import draw_by_content
from gsvis.scene.gaussians import Gaussians

__all__ = ["thin"]

I64 = NDArray[np.int64]

_ROUNDS = 8  # of the search for the factor that keeps as many as asked for
_WIDEST = 8.0  # factor by which a Gaussian is widened at most


def thin(g: Gaussians, most: int, *, seed: int = 0) -> tuple[I64, Gaussians]:
    """Return the ids of about `most` Gaussians, ascending, and these Gaussians, widened, with base colors only.

    Args:
        g: The scene, N Gaussians.
        most: Number of Gaussians to keep, at least 1; a smaller scene is unchanged.
        seed: Seed of the sample.
    """
    _check.positive_int("most", most)
    if len(g) <= most:
        return np.arange(len(g)), Gaussians(g.means, g.quats, g.scales, g.opacities, g.sh0, facts=g.facts)
    scales = np.sort(g.scales.astype(np.float64), axis=1)
    wide = np.sqrt(np.maximum(scales[:, 1] * scales[:, 2], 1e-300) * g.opacities)  # side of the area that it covers
    chance = _chances(wide, most)
    ids = np.flatnonzero(draw_by_content(g, seed) < chance)
    factor = np.minimum(1.0 / np.sqrt(chance[ids]), _WIDEST)
    few = g[ids]
    wider = few.scales * factor[:, None].astype(np.float32)
    return ids, Gaussians(few.means, few.quats, wider, few.opacities, few.sh0, facts=g.facts)


def _chances(wide: NDArray[np.float64], most: int) -> NDArray[np.float64]:
    """Return the probability (N,) of keeping each Gaussian, by the side of its area; about `most` are kept."""
    share = wide / max(float(wide.max()), 1e-300)
    factor = most / max(float(share.sum()), 1e-300)
    for _ in range(_ROUNDS):
        chance = np.minimum(factor * share, 1.0)
        factor *= most / max(float(chance.sum()), 1e-300)
    return np.asarray(np.clip(factor * share, 1e-300, 1.0))
