"""Test whether eyes lie inside opaque Gaussians. Scene frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis.scene._kernels import alpha as kernels
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.morton import morton_order

__all__ = ["BURIED", "Solid", "buried"]

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

BURIED = 0.5
"""Alpha at the eye above which the eye counts as inside something solid."""

_IN_A_BIN = 4  # points, on average
_MOST_BINS = 32  # along an axis
_FEW = 8192  # points that are tested against runs
_IN_A_RUN = 64  # Gaussians with one box around them


@dataclass(frozen=True, eq=False)
class Solid:
    """The K Gaussians of a scene that can hold a point inside, with boxes around their opaque parts.

    Attributes:
        gaussians: The scene.
        ids: (K,) int64, Gaussians with an opacity of at least a half, along a Morton curve.
        low: (K, 3) lowest corners of the boxes.
        high: (K, 3) highest corners.
        runs_low: (B, 3) lowest corners of the boxes around runs of 64 neighbors.
        runs_high: (B, 3) their highest corners.
    """

    gaussians: Gaussians
    ids: I64
    low: F64
    high: F64
    runs_low: F64
    runs_high: F64

    @classmethod
    def from_scene(cls, g: Gaussians) -> Solid:
        """Return the Gaussians of a scene that can hold a point inside."""
        ids = np.flatnonzero(g.opacities >= BURIED)
        ids = ids[morton_order(g.means[ids])]
        reach = np.sqrt(2.0 * np.log(g.opacities[ids].astype(np.float64) / BURIED)) * g.scales[ids].max(axis=1)
        means = g.means[ids].astype(np.float64)
        return cls._of_boxes(g, ids, means - reach[:, None], means + reach[:, None])

    @classmethod
    def _of_boxes(cls, g: Gaussians, ids: I64, low: F64, high: F64) -> Solid:
        """Return Gaussians with their boxes, and with the boxes around runs of them."""
        starts = np.arange(0, len(ids), _IN_A_RUN)
        if len(starts) == 0:
            return cls(g, ids, low, high, low, high)
        return cls(g, ids, low, high, np.minimum.reduceat(low, starts), np.maximum.reduceat(high, starts))

    def near(self, low: F64, high: F64) -> Solid:
        """Return the Gaussians that can hold a point of the box between two corners (3,)."""
        runs = np.flatnonzero(np.all((self.runs_high >= low) & (self.runs_low <= high), axis=1))
        some = (_IN_A_RUN * runs[:, None] + np.arange(_IN_A_RUN)).ravel()
        some = some[: np.searchsorted(some, len(self.ids))]
        near = some[np.all((self.high[some] >= low) & (self.low[some] <= high), axis=1)]
        return Solid._of_boxes(self.gaussians, self.ids[near], self.low[near], self.high[near])

    def buries(self, points: F64) -> NDArray[np.bool_]:
        """Return which points (P, 3) lie inside a Gaussian with an alpha of at least a half there.

        Points are sorted into bins, so that each Gaussian is tested only against those in and around its box. Few
        points are tested against runs of Gaussians first.
        """
        found = np.zeros(len(points), bool)
        if len(points) == 0:
            return found
        low = points.min(axis=0)
        high = points.max(axis=0)
        near = self.near(low, high) if len(points) > _FEW else self
        if len(near.ids) == 0:
            return found
        side = max(1, min(_MOST_BINS, int(np.cbrt(len(points) / _IN_A_BIN))))
        per_unit = np.divide(side, high - low, out=np.zeros(3), where=high > low)
        numbers = np.empty(len(points), np.int64)
        kernels.bin_points(np.ascontiguousarray(points), low, per_unit, side, numbers)
        order = np.argsort(numbers, kind="stable")
        binned = np.ascontiguousarray(points[order])
        bins = low, per_unit, np.concatenate([[0], np.cumsum(np.bincount(numbers, minlength=side**3))])
        holding = np.zeros(len(near.ids), bool)
        if len(points) > _FEW:
            kernels.find_holding(near.low, near.high, binned, bins, side, holding)
        else:
            runs = near.runs_low, near.runs_high, _IN_A_RUN
            kernels.find_holding_in_runs(near.low, near.high, binned, *runs, holding)
        some = self.gaussians[near.ids[holding]]
        whitening = np.swapaxes(some.rotations(), 1, 2) / some.scales.astype(np.float64)[:, :, None]
        shapes = some.means, np.ascontiguousarray(whitening), some.opacities
        inside = np.zeros(len(points), bool)
        kernels.find_buried(shapes, near.low[holding], near.high[holding], binned, bins, side, BURIED, inside)
        found[order] = inside
        return found


def buried(g: Gaussians, points: F64) -> NDArray[np.bool_]:
    """Return which points (P, 3) lie inside a Gaussian with an alpha of at least a half there."""
    return Solid.from_scene(g).buries(points)
