"""Test where a scene is solid: eyes inside a Gaussian that hides what is behind it. Scene frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis.scene._kernels import alpha as kernels
from gsvis.scene.gaussians import Gaussians

__all__ = ["BURIED", "Solid", "buried"]

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

BURIED = 0.5
"""Alpha at the eye above which the eye counts as inside something solid."""

_FEW = 64  # points that are tested together


@dataclass(frozen=True, eq=False)
class Solid:
    """The K Gaussians of a scene that can bury a point, with the boxes within which they do.

    Attributes:
        gaussians: The scene.
        ids: (K,) int64, Gaussians with an opacity of at least a half.
        low: (K, 3) lowest corners of the boxes.
        high: (K, 3) highest corners.
    """

    gaussians: Gaussians
    ids: I64
    low: F64
    high: F64

    @classmethod
    def from_scene(cls, g: Gaussians) -> Solid:
        """Return what can bury a point of a scene."""
        ids = np.flatnonzero(g.opacities >= BURIED)
        reach = np.sqrt(2.0 * np.log(g.opacities[ids].astype(np.float64) / BURIED)) * g.scales[ids].max(axis=1)
        means = g.means[ids].astype(np.float64)
        return cls(g, ids, means - reach[:, None], means + reach[:, None])

    def near(self, low: F64, high: F64) -> Solid:
        """Return what can bury a point of the box between two corners (3,)."""
        near = np.all((self.high >= low) & (self.low <= high), axis=1)
        return Solid(self.gaussians, self.ids[near], self.low[near], self.high[near])

    def buries(self, points: F64) -> NDArray[np.bool_]:
        """Return which points (P, 3) lie inside a Gaussian with an alpha of at least a half there.

        The points are halved until few are left, so that each part meets only the Gaussians that reach its box.
        """
        if len(points) == 0 or len(self.ids) == 0:
            return np.zeros(len(points), bool)
        low, high = points.min(axis=0), points.max(axis=0)
        some = self.near(low, high)
        if len(points) <= _FEW:
            return some._largest_alpha(points) >= BURIED
        axis = int((high - low).argmax())
        order = np.argpartition(points[:, axis], len(points) // 2)
        found = np.empty(len(points), bool)
        for part in (order[: len(points) // 2], order[len(points) // 2 :]):
            found[part] = some.buries(points[part])
        return found

    def _largest_alpha(self, points: F64) -> F64:
        """Return (P,) the largest alpha of these Gaussians at each point."""
        some = self.gaussians[self.ids]
        whitening = np.swapaxes(some.rotations(), 1, 2) / some.scales.astype(np.float64)[:, :, None]
        alphas = np.zeros(len(points))
        kernels.largest_alpha(
            some.means, np.ascontiguousarray(whitening), some.opacities, np.ascontiguousarray(points), alphas
        )
        return alphas


def buried(g: Gaussians, points: F64) -> NDArray[np.bool_]:
    """Return which points (P, 3) lie inside a Gaussian with an alpha of at least a half there."""
    return Solid.from_scene(g).buries(points)
