"""Estimate which Gaussians a camera can see, from rays through voxels: cheap and approximate.

Most of a building is hidden from any one camera. This module finds the rest, to about a voxel, without testing single
Gaussians. It can err at thin walls and windows. Use it only to save work where a few missed Gaussians do no harm, never
to decide visibility. Scene frame; OpenCV cameras.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.scene._kernels.in_sight import mark_crossed, mark_seen
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace

__all__ = ["InSight"]

Mask = NDArray[np.bool_]

_RAYS = 96, 72  # across the image and down it
_WALLS = 4  # steps in occupied voxels after which a ray ends
_REACHES = (1, 2, 4, 8)  # voxels that a Gaussian may reach beyond its own, doubling; larger ones are always in sight
_DEVIATIONS = 2.0  # of a Gaussian, that count as its reach


@dataclass(frozen=True, eq=False)
class InSight:
    """The voxels of a space, and the position of each Gaussian of a scene in it.

    Attributes:
        space: Voxels that stop light.
        voxels: (N,) int32 or int64, flat index of the voxel of each Gaussian; -1 for Gaussians that are always in
            sight, because they are outside of the grid or too large.
        reaches: (N,) index of the reach of each Gaussian.
        walls: Steps in occupied voxels after which a ray ends.
    """

    space: NavigableSpace
    voxels: NDArray[Any]
    reaches: NDArray[np.int8]
    walls: int = _WALLS

    @classmethod
    def from_scene(cls, g: Gaussians, space: NavigableSpace, *, walls: int = _WALLS) -> InSight:
        """Place N Gaussians in the voxels of a space.

        Args:
            g: The scene.
            space: Its space; without occupied voxels, nothing is hidden.
            walls: Steps in occupied voxels after which a ray ends; more steps make fewer errors at thin walls, and hide
                less.
        """
        shape = np.array(space.occupied.shape)
        places = np.floor((g.means.astype(np.float64) - space.origin) / space.voxel_size)
        inside = np.all((places >= 0) & (places < shape), axis=1) & bool(space.occupied.size)
        voxels = np.full(len(g), -1, np.min_scalar_type(-max(space.occupied.size, 1 << 16)))
        voxels[inside] = np.ravel_multi_index(tuple(places[inside].astype(np.int64).T), tuple(shape))
        sizes = _DEVIATIONS * g.scales.max(axis=1) / space.voxel_size
        reaches = np.searchsorted(_REACHES, sizes).astype(np.int8)
        voxels[reaches == len(_REACHES)] = -1
        return cls(space, voxels, reaches, walls)

    def of(self, camera: Cameras) -> Mask:
        """Return a mask (N,): whether one camera may see each Gaussian."""
        seen = np.empty(len(self.voxels), bool)
        mark_seen(self.voxels, self.reaches, self._near(camera).ravel(), seen)
        return seen

    def only(self, chosen: NDArray[np.int64]) -> InSight:
        """Return the same for some of the Gaussians, by their (K,) indices."""
        return replace(self, voxels=self.voxels[chosen], reaches=self.reaches[chosen])

    def _near(self, camera: Cameras) -> NDArray[np.uint8]:
        """Return (X, Y, Z) voxels; bit r is set for those within reach r of a voxel that a camera has in sight."""
        space = self.space
        grown = np.zeros(space.occupied.shape, bool)
        eye = (camera.viewpoints[0] - space.origin) / space.voxel_size
        mark_crossed(np.ascontiguousarray(space.occupied), eye, _directions(camera), self.walls, grown)
        near = np.zeros(grown.shape, np.uint8)
        last = 0
        for index, reach in enumerate(_REACHES):
            grown = _grow(grown, reach - last)
            last = reach
            near |= grown.view(np.uint8) << np.uint8(index)
        return near


def _directions(camera: Cameras) -> NDArray[np.float64]:
    """Return (R, 3) unit vectors through a grid of points of the image of one camera."""
    u, v = ((np.arange(n) + 0.5) / n * side for n, side in zip(_RAYS, (camera.width, camera.height), strict=True))
    pixels = np.stack([*(grid.ravel() for grid in np.meshgrid(u, v)), np.ones(_RAYS[0] * _RAYS[1])], axis=1)
    directions = np.linalg.solve(camera.Ks[0], pixels.T).T @ camera.viewmats[0, :3, :3]
    return np.ascontiguousarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))


def _grow(mask: Mask, steps: int) -> Mask:
    """Return a mask (X, Y, Z) grown by a number of voxels, diagonals included.

    `steps` must be 1 or at most the number of steps by which the mask was grown before, so that no gaps arise.
    """
    for axis in range(3):
        wide = mask.copy()
        low = [slice(None)] * 3
        high = [slice(None)] * 3
        low[axis], high[axis] = slice(None, -steps), slice(steps, None)
        wide[tuple(low)] |= mask[tuple(high)]
        wide[tuple(high)] |= mask[tuple(low)]
        mask = wide
    return mask
