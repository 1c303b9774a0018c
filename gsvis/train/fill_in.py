"""Fit the opacities of merged Gaussians to images, in closed form, before training begins.

A merged Gaussian covers as much as its parts did. That is right where no other Gaussians remain, but too much, like
fog, where others cover the same place. The images decide.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsvis.render.removal import removal_effects
from gsvis.scene.gaussians import Gaussians
from gsvis.train.images import PosedImages

__all__ = ["fit_opacities", "views_used"]

_VIEWS = 20  # of each turn
_TURNS = 2
_DAMPING = 0.5  # many change the same pixel at once
# factor of one turn
_LEAST = 0.3
_MOST = 1.5
_RANGE = 0.01, 0.99  # range of opacities


def views_used(count: int) -> int:
    """Return how many views `fit_opacities` looks at if it gets `count`, in all turns together."""
    return sum(len(_views_of(turn, count)) for turn in range(_TURNS))


def _views_of(turn: int, count: int) -> NDArray[np.int64]:
    """Return the views of a turn."""
    return np.unique(np.arange(turn * _VIEWS, (turn + 1) * _VIEWS) % count)


def fit_opacities(merged: Gaussians, stays: Gaussians, views: PosedImages) -> Gaussians:
    """Return merged Gaussians with opacities that match images better.

    A pixel is linear in the alpha of one Gaussian: with s times its alpha, the residual r becomes r + (1 - s) D, where
    D is the change by removal. The squared error is least at 1 - s = -sum(r D) / sum(D^2). Each of two turns takes half
    of that step. A Gaussian that no view of a turn shows keeps its opacity.

    Args:
        merged: M Gaussians to fit.
        stays: The other Gaussians, which remain unchanged.
        views: Images of the whole scene; the first 40 are used, or all if there are fewer.

    Returns:
            The same Gaussians with new opacities.
    """
    for turn in range(_TURNS):
        some = _views_of(turn, len(views))
        both = Gaussians.concatenate([stays, merged])
        effects = removal_effects(both, views.cameras[some], images=views.images[some])
        squared = effects.squared[len(stays) :]
        change = effects.error_change[len(stays) :]
        crossed = 0.5 * (change - squared)  # sum(r D)
        with np.errstate(divide="ignore", invalid="ignore"):
            step = np.where(squared > 0.0, crossed / squared, 0.0)
        factors = np.clip(1.0 + _DAMPING * step, _LEAST, _MOST)
        opacities = np.clip(merged.opacities * factors, *_RANGE).astype(np.float32)
        opacities = np.where(squared > 0.0, opacities, merged.opacities)
        m = merged
        merged = Gaussians(m.means, m.quats, m.scales, opacities, m.sh0, m.shN, facts=m.facts)
    return merged
