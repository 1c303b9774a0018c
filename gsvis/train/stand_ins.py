"""Merged Gaussians that stand in for those that may go, while others are weighed.

A level replaces what it lacks by a few merged Gaussians. A part of a plain wall is missed little then, a part of a
pattern much. Without them both leave the same hole. Scene frame.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsvis.scene.gaussians import Gaussians
from gsvis.scene.in_sight import InSight
from gsvis.scene.navigable import NavigableSpace
from gsvis.train.pairs import merge_pairs_grouped

__all__ = ["STAND_INS", "StandIns"]

STAND_INS = 0.03
"""Their number, as a share of the Gaussians: about what a level has of its own for what it lacks."""


class StandIns:
    """Stand-ins of a scene.

    Args:
        g: N Gaussians.
        space: Voxels that stop light; None looks at all stand-ins.
        share: Number of the stand-ins, as a share of N.

    Attributes:
        gaussians: M merged Gaussians, at least 1; independent of the order of the scene unless centers are equal.
        groups: (N,) the stand-in of each Gaussian.
        sight: Stand-ins that a camera may see; None for all.
    """

    def __init__(self, g: Gaussians, space: NavigableSpace | None, share: float = STAND_INS) -> None:
        order = np.lexsort(g.means.T)
        self.gaussians, groups = merge_pairs_grouped(g[order], max(round(share * len(g)), 1))
        self.groups = np.empty(len(g), np.int64)
        self.groups[order] = groups
        self.sight = None if space is None else InSight.from_scene(self.gaussians, space)
        self._sizes = np.bincount(groups, minlength=len(self.gaussians))

    def presence(self, kept: NDArray[np.int64], chances: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return (M,) how far each is there: the share of its Gaussians that is expected to go.

        Args:
            kept: (K,) indices of the Gaussians that are left.
            chances: (K,) probability of each to stay.
        """
        staying = np.bincount(self.groups[kept], chances.astype(np.float64), minlength=len(self._sizes))
        return np.clip(1.0 - staying / self._sizes, 0.0, 1.0).astype(np.float32)
