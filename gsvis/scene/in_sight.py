"""Estimate which Gaussians a camera can see, from rays through voxels: cheap and approximate.

Most of a building is hidden from any one camera. This module finds the rest, to about a voxel, without testing single
Gaussians. It can err at thin walls and windows. Use it only to save work where a few missed Gaussians do no harm, never
to decide visibility. Scene frame; OpenCV cameras.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.scene._kernels.in_sight import grow, mark_crossed, mark_seen
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace

__all__ = ["InSight"]

Mask = NDArray[np.bool_]
Words = NDArray[np.uint64]

_RAYS = 96, 72  # across the image and down it
_WALLS = 4  # steps in occupied voxels after which a ray ends
_REACHES = (1, 2, 4, 8)  # voxels that a Gaussian may reach beyond its own, doubling; larger ones are always in sight
_WORD = 64  # voxels
_DEVIATIONS = 2.0  # of a Gaussian, that count as its reach


@dataclass(frozen=True, eq=False)
class InSight:
    """The voxels of a space, and the position of each Gaussian of a scene in it.

    Attributes:
        space: Voxels that stop light.
        voxels: (N,) int32 or int64, the bit of the voxel of each Gaussian among the words of all columns of voxels, of
            64 voxels each; -1 for Gaussians that are always in sight, because they are outside of the grid or too
            large.
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
        columns = (*space.occupied.shape[:2], _WORD * _words_along(space))
        voxels = np.full(len(g), -1, np.min_scalar_type(-max(math.prod(columns), 1 << 16)))
        voxels[inside] = np.ravel_multi_index(tuple(places[inside].astype(np.int64).T), columns)
        sizes = _DEVIATIONS * g.scales.max(axis=1) / space.voxel_size
        reaches = np.searchsorted(_REACHES, sizes).astype(np.int8)
        voxels[reaches == len(_REACHES)] = -1
        return cls(space, voxels, reaches, walls)

    def of(self, camera: Cameras) -> Mask:
        """Return a mask (N,): whether one camera may see each Gaussian."""
        seen = np.empty(len(self.voxels), bool)
        mark_seen(self.voxels, self.reaches, self._near(camera).reshape(len(_REACHES), -1), seen)
        return seen

    def only(self, chosen: NDArray[np.int64]) -> InSight:
        """Return the same for some of the Gaussians, by their (K,) indices."""
        return replace(self, voxels=self.voxels[chosen], reaches=self.reaches[chosen])

    def join(self, other: InSight) -> InSight:
        """Return the Gaussians of this, then those of another scene in the same space; with `walls` of this."""
        voxels = np.concatenate([self.voxels, other.voxels])
        return replace(self, voxels=voxels, reaches=np.concatenate([self.reaches, other.reaches]))

    def _near(self, camera: Cameras) -> Words:
        """Return (R, X, Y, W); bits in row r: the voxels within reach r of a voxel that a camera has in sight."""
        space = self.space
        crossed = np.zeros((*space.occupied.shape[:2], _words_along(space)), np.uint64)
        eye = (camera.viewpoints[0] - space.origin) / space.voxel_size
        mark_crossed(np.ascontiguousarray(space.occupied), eye, _directions(camera), self.walls, crossed)
        near = np.empty((len(_REACHES), *crossed.shape), np.uint64)
        room = np.empty_like(crossed)
        before = crossed
        last = 0
        for grown, reach in zip(near, _REACHES, strict=True):
            grow(before, reach - last, room, grown)
            before = grown
            last = reach
        return near


def _words_along(space: NavigableSpace) -> int:
    """Return the number of words of 64 bits for the voxels of a space along Z."""
    return -(-int(space.occupied.shape[2]) // _WORD)


def _directions(camera: Cameras) -> NDArray[np.float64]:
    """Return (R, 3) unit vectors through a grid of points of the image of one camera."""
    u, v = ((np.arange(n) + 0.5) / n * side for n, side in zip(_RAYS, (camera.width, camera.height), strict=True))
    pixels = np.stack([*(grid.ravel() for grid in np.meshgrid(u, v)), np.ones(_RAYS[0] * _RAYS[1])], axis=1)
    directions = np.linalg.solve(camera.Ks[0], pixels.T).T @ camera.viewmats[0, :3, :3]
    return np.ascontiguousarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))
