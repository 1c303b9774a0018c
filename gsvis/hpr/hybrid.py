"""The z-buffer and hidden point removal together: what one eye sees (paper, section 6.2). World frame, scene units.

The z-buffer says how much light reaches each Gaussian, at the size of its pixels. Where that leaves doubt - a Gaussian
that light reaches, though no pixel center shows enough of it - the hull of the places at which light ends decides: in
front of it the Gaussian lies on a surface that the eye sees, behind it in the depth of one.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from gsvis import _check
from gsvis.hpr.gaussians import OcclusionHull
from gsvis.hpr.zbuffer import Seen, Splats, look_around
from gsvis.raycast import TAU
from gsvis.scene.gaussians import Gaussians

__all__ = ["hybrid"]

_HULL_SIZE = 64
"""Cells along a side of the faces of the hull; finer ones cost more than they tell."""

_DOUBT = 0.5
"""A Gaussian is in doubt from this share of tau on, if its peak would have tau in the light that reaches it."""


def hybrid(
    g: Gaussians, splats: Splats, viewpoint: ArrayLike, *, size: int = 256, tau: float = TAU, margin: float = 0.1
) -> Seen:
    """What an eye sees, by the z-buffer and hidden point removal together.

    Args:
        g: The scene.
        splats: The same scene laid out by `Splats.of`.
        viewpoint: (3,) the eye.
        size: Pixels along a side of the six faces of the z-buffer.
        tau: Weight in (0, 1) from which a Gaussian is visible.
        margin: Of the hull, see `OcclusionHull.from_scene`.

    Returns:
        The Gaussians of weight tau or more; those that the hull decided for have the weight tau.

    Raises:
        ValueError: If an argument is out of range, or the splats are of another scene.
    """
    if splats.total != len(g):
        raise ValueError(
            f"splats: expected those of this scene of {len(g)} Gaussians, got {splats.total}; use Splats.of"
        )
    if not 0.0 < tau < 1.0:
        raise ValueError(f"tau: expected a weight in (0, 1), got {tau!r}")
    seen = look_around(splats, viewpoint, size=_check.positive_int("size", size, at_least=4), spent=tau)
    weights, limit = seen.weights, np.float32(tau)
    peak = seen.light * g.opacities[seen.ids]
    doubtful = np.flatnonzero((weights < limit) & (weights >= np.float32(_DOUBT) * limit) & (peak >= limit))
    if len(doubtful):
        levels = seen.zbuffer.pyramid()
        level = max(k for k in range(len(levels)) if k == 0 or levels[k].shape[1] >= _HULL_SIZE)
        hull = OcclusionHull.from_depths(g[seen.ids[doubtful]], viewpoint, levels[level], margin=margin)
        weights = weights.copy()
        weights[doubtful[hull.nearness() <= 1.0]] = limit
    kept = weights >= limit
    return replace(seen, ids=seen.ids[kept], weights=weights[kept], light=seen.light[kept])
