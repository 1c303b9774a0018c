"""Measure how much light the Gaussians of a scene absorb in each voxel of a grid. Scene frame and units.

The same measure as for navigable space, on a grid over any box. Gaussians much thicker than a voxel are added on
coarser grids, so that time does not grow with their volume.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.scene._occupancy import MIN_ALPHA, optical_depth
from gsvis.scene.gaussians import Gaussians

__all__ = ["MOST_RESOLUTION", "Density"]

F64 = NDArray[np.float64]
Depth = NDArray[np.float32]

MOST_RESOLUTION = 4096
"""Most voxels along the longest side of a grid."""

_THICK = 2.0  # voxels: thinnest standard deviation from which a Gaussian is entered into a coarser grid


@dataclass(frozen=True, eq=False)
class Density:
    """A grid of optical depths.

    Attributes:
        origin: (3,) lowest corner of voxel (0, 0, 0), scene frame.
        voxel_size: Side of a voxel, scene units.
        depth: (X, Y, Z) float32, the sum of -log(1 - alpha) over the Gaussians at the middle of each voxel.
    """

    origin: F64
    voxel_size: float
    depth: Depth

    @classmethod
    def from_scene(cls, g: Gaussians, low: ArrayLike, high: ArrayLike, resolution: int = 192) -> Density:
        """Measure a scene over a box.

        Args:
            g: The scene; Gaussians with an opacity below 1/255 are left out.
            low: (3,) lowest corner.
            high: (3,) highest corner.
            resolution: Voxels along the longest side, 8 to 4096.

        Raises:
            ValueError: If the box is empty, or `resolution` is out of range.
        """
        return cls.from_parts([g], low, high, resolution)

    @classmethod
    def from_parts(cls, parts: Iterable[Gaussians], low: ArrayLike, high: ArrayLike, resolution: int = 192) -> Density:
        """Measure a scene that comes in parts, of which one is in memory at a time; arguments as for `from_scene`.

        Raises:
            ValueError: If the box is empty, or `resolution` is out of range.
        """
        corner = _check.floats("low", low, (3,), np.float64)
        side = _check.floats("high", high, (3,), np.float64) - corner
        if not (side.min() >= 0.0 and side.max() > 0.0):
            raise ValueError(f"high: expected a corner above low, got sides {side.tolist()}")
        if not 8 <= _check.positive_int("resolution", resolution) <= MOST_RESOLUTION:
            raise ValueError(f"resolution: expected a value in [8, {MOST_RESOLUTION}], got {resolution}")
        size = float(side.max()) / resolution
        counts = np.clip(np.ceil(side / size - 1e-6), 1, resolution).astype(int)
        shape = int(counts[0]), int(counts[1]), int(counts[2])
        origin = corner + 0.5 * (side - counts * size)
        depth = np.zeros(shape, np.float32)
        for part in parts:
            _add_depth(part[part.opacities >= MIN_ALPHA], origin, size, depth)
        return cls(origin, size, depth)

    def voxels_of(self, points: ArrayLike) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Return the voxels (P, 3) of points (P, 3), 0 off the grid, and (P,) whether they lie on the grid."""
        array = _check.floats("points", points, ("P", 3), np.float64)
        with np.errstate(over="ignore"):
            places = (array - self.origin) / self.voxel_size
        within = np.all((places >= 0.0) & (places < self.depth.shape), axis=1)
        return np.where(within[:, None], places, 0.0).astype(np.int64), within

    def look_up(self, grid: NDArray[np.bool_], points: ArrayLike) -> NDArray[np.bool_]:
        """Return the values (P,) of a mask (X, Y, Z) at points (P, 3); False outside the grid."""
        voxels, within = self.voxels_of(points)
        return np.asarray(within & grid[voxels[:, 0], voxels[:, 1], voxels[:, 2]])


def _add_depth(seen: Gaussians, origin: F64, size: float, depth: Depth) -> None:
    """Add the optical depth of Gaussians to a grid (X, Y, Z)."""
    thickness = seen.scales.min(axis=1).astype(np.float64) / size if len(seen) else np.zeros(0)
    level = np.floor(np.log2(np.maximum(thickness / _THICK, 0.5))).astype(int) + 1
    level = np.minimum(level, int(np.log2(max(depth.shape))))
    x, y, z = depth.shape
    depth += optical_depth(seen[level == 0], origin, size, (x, y, z))
    for k in np.unique(level[level > 0]).tolist():
        step = 1 << k
        coarse = optical_depth(seen[level == k], origin, size * step, (-(-x // step), -(-y // step), -(-z // step)))
        for axis in range(3):
            coarse = np.repeat(coarse, step, axis=axis)
        depth += coarse[:x, :y, :z]
