"""Find the Gaussians that are visible from a viewpoint by the z-buffer and hidden point removal (paper, section 6.2).

The z-buffer measures how much light reaches each Gaussian, at the size of its pixels. A Gaussian is in doubt if light
reaches it but no pixel center shows enough of it. Then the hull of the places where light is spent decides: a Gaussian
in front of it lies on a visible surface, one behind it lies inside. World frame, scene units.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from gsvis import _check
from gsvis.hpr.gaussians import ON_HULL, OcclusionHull
from gsvis.hpr.zbuffer import FOLDS, Search, Seen, Splats, look_around
from gsvis.raycast import TAU
from gsvis.scene.gaussians import Gaussians

__all__ = ["hybrid"]

_HULL_SIZE = 32
"""Fewest cells along a side of the faces of the hull. Finer ones cost more and reject more that finer pixels show."""

_DOUBT = 0.5
"""Share of tau above which a Gaussian is in doubt, if its peak would have weight tau in the light that reaches it.

Light counts as spent below the same share, so that no Gaussian in doubt is missed.
"""


def hybrid(
    g: Gaussians,
    splats: Splats,
    viewpoint: ArrayLike,
    *,
    size: int = 256,
    tau: float = TAU,
    margin: float | None = 0.1,
    faint: float | None = None,
    search: Search | None = None,
) -> Seen:
    """Find what an eye sees, by the z-buffer and hidden point removal together.

    Args:
        g: The scene.
        splats: The same scene, laid out by `Splats.from_gaussians`.
        viewpoint: (3,) the eye.
        size: Pixels along a side of the six faces of the z-buffer.
        tau: Least weight of a visible Gaussian, in (0, 1).
        margin: Margin of the hull; see `OcclusionHull.from_scene`. None accepts all Gaussians in doubt and keeps no
            z-buffer, which saves memory for large faces.
        faint: Weight in (0, tau] from which fainter Gaussians are returned too, if at least half of tau of the light
            reaches them; None for none.
        search: What is looked for, and where; None finds everything everywhere. Its `least` is ignored: it is half of
            tau if some Gaussians are known. Squares need `margin` to be None.

    Returns:
        The Gaussians of weight tau or more; those accepted by the hull have the weight tau. Then the fainter ones, with
        the weights that the z-buffer measured.

    Raises:
        ValueError: If an argument is out of range, or the splats belong to another scene.
    """
    if splats.total != len(g):
        raise ValueError(
            f"splats: expected {len(g)} Gaussians, those of this scene, got {splats.total}; use Splats.from_gaussians"
        )
    if not 0.0 < tau < 1.0:
        raise ValueError(f"tau: expected a weight in (0, 1), got {tau!r}")
    least = tau if faint is None else faint
    if not 0.0 < least <= tau:
        raise ValueError(f"faint: expected a weight in (0, {tau:g}], got {faint!r}")
    pixels = _check.positive_int("size", size, at_least=4)
    spent = _DOUBT * tau
    search = search or Search()
    if search.known is not None:
        search = replace(search, least=spent)
    fold = max(f for f in FOLDS if f == 1 or pixels > f * (_HULL_SIZE - 1))
    buffer = margin is not None
    seen = look_around(splats, viewpoint, size=pixels, spent=spent, buffer=buffer, fold=fold, search=search)
    weights = seen.weights
    limit = np.float32(tau)
    doubtful = np.flatnonzero((weights < limit) & (weights >= np.float32(_DOUBT) * limit))
    peak = seen.light[doubtful] * g.opacities[seen.ids[doubtful]]
    doubtful = doubtful[peak >= limit]
    if len(doubtful) and margin is not None:
        levels = seen.zbuffer.pyramid()
        level = max(k for k in range(len(levels)) if k == 0 or levels[k].shape[1] >= _HULL_SIZE)
        ends = OcclusionHull.from_depths(g[seen.ids[doubtful]], viewpoint, levels[level], margin=margin)
        doubtful = doubtful[ends.nearness() <= ON_HULL]
    if len(doubtful):
        weights = weights.copy()
        weights[doubtful] = limit
    kept = weights >= np.float32(least)
    return replace(seen, ids=seen.ids[kept], weights=weights[kept], light=seen.light[kept])
