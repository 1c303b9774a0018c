"""Find Gaussians that are far outside, hazy, large, or in lonely groups, from the Gaussians alone.

Scene frame and units. A grid of optical depths finds surfaces; isolated groups of few Gaussians are not surfaces. This
module knows no eyes.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gsvis.errors import SceneError
from gsvis.scene.density import Density
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.inspection import FLOATER_EXTENT, MIN_ALPHA

__all__ = ["FEW", "RESOLUTION", "Shape", "Surfaces", "affordable_resolution", "far_from", "find_surfaces"]

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

RESOLUTION = 384  # voxels along the longest side
SURFACE = 0.1  # optical depth of a voxel, at strength 1, from which it belongs to a surface
FEW = 24  # Gaussians, at strength 1, of a group that is no surface, and around a Gaussian that is alone
SMALL = 1000  # voxels of such a group, at strength 1
LARGE = 0.01  # middle standard deviation of a large Gaussian, as a share of the longest side
ROUND = 0.3  # least over middle standard deviation of a large Gaussian that is no disc
FAINT = 0.3  # opacity below which a large Gaussian does not count as part of a surface
_VOXELS = 1 << 24  # of a grid, at most


@dataclass(frozen=True, eq=False)
class Shape:
    """Properties of the Gaussians that need no eyes.

    Attributes:
        far: (N,) whether the center lies outside 5 times the robust box.
        hazy: (N,) whether it is large in all directions and faint.
        large: (N,) whether the middle standard deviation is at least 1% of the longest side of the robust box; False in
            a scene that lies in one point.
        lonely: (N,) whether the center is not at a surface, but in a small group or in thin haze; False in a scene
            without surfaces.
        low: (3,) lowest corner of the robust box.
        high: (3,) highest corner.
    """

    far: Mask
    hazy: Mask
    large: Mask
    lonely: Mask
    low: F64
    high: F64

    @classmethod
    def from_scene(cls, g: Gaussians) -> Shape:
        """Measure a scene.

        Raises:
            SceneError: If no Gaussian has an opacity of at least 1/255.
        """
        can_be_seen = g.opacities >= MIN_ALPHA
        if not can_be_seen.any():
            raise SceneError("the scene has no Gaussian with an opacity of at least 1/255: there is nothing to see")
        shape = cls.within(g, *g[can_be_seen].bounds(0.98))
        core = shape.core & can_be_seen
        if not (core.any() and np.any(shape.high > shape.low)):
            return shape
        lonely = np.zeros(len(g), bool)
        lonely[core] = Surfaces.over([g[core]], shape.low, shape.high).lonely(g[core].means)
        return replace(shape, lonely=lonely)

    @classmethod
    def within(cls, g: Gaussians, low: F64, high: F64) -> Shape:
        """Measure a part of a scene by the robust box (3,), (3,) of the whole; does not search lonely groups."""
        half = 0.5 * (high - low)
        far = far_from(g.means, low, high)
        least, mid, _ = np.sort(g.scales, axis=1).T
        large = (mid >= LARGE * 2.0 * half.max()) & bool(half.max() > 0.0)
        hazy = large & (least >= ROUND * mid) & (g.opacities <= FAINT)
        return cls(np.asarray(far), np.asarray(hazy), np.asarray(large), np.zeros(len(g), bool), low, high)

    @property
    def core(self) -> Mask:
        """(N,) Gaussians that hide others: neither far outside nor hazy."""
        return ~(self.far | self.hazy)

    @property
    def surfaces(self) -> Mask:
        """(N,) Gaussians between which navigable space is searched: the core without lonely groups."""
        return self.core & ~self.lonely


def far_from(means: NDArray[np.float32], low: F64, high: F64) -> Mask:
    """Return which centers (N, 3) lie outside 5 times a robust box; none if the box is a point."""
    middle = 0.5 * (low + high)
    half = 0.5 * (high - low)
    far = np.any(np.abs(means - middle) > FLOATER_EXTENT * np.maximum(half, 0.02 * half.max()), axis=1)
    return np.asarray(far & bool(half.max() > 0.0))


def affordable_resolution(sides: F64, resolution: int) -> int:
    """Return the voxels along the longest side, at most `resolution`, of a grid of at most 16 million voxels.

    Args:
        sides: (3,) sides of the box, the longest above 0.
        resolution: Requested voxels along the longest side.
    """
    shares = np.maximum(sides / sides.max(), 1.0 / resolution)
    return int(np.clip(np.cbrt(_VOXELS / np.prod(shares)), 8, resolution))


def find_surfaces(parts: Iterable[Gaussians], density: Density, strength: float) -> Mask:
    """Return which voxels belong to surfaces.

    A voxel that absorbs much light belongs to a surface, unless its connected group is small and holds few centers.

    Args:
        parts: The Gaussians of the grid, in parts.
        density: The grid, (X, Y, Z) voxels.
        strength: Factor on the size of a group that is too small, above 0.

    Returns:
        (X, Y, Z) bool.
    """
    from scipy import ndimage

    labels, count = ndimage.label(density.depth >= SURFACE * strength, np.ones((3, 3, 3), bool))
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    held = np.zeros(count + 1, np.int64)
    for part in parts:
        voxels, within = density.voxels_of(part.means)
        held += np.bincount(labels[tuple(voxels[within].T)], minlength=count + 1)
    is_surface = (held > FEW * strength) | (sizes > SMALL * strength)
    is_surface[0] = False
    return np.asarray(is_surface[labels])


@dataclass(frozen=True, eq=False)
class Surfaces:
    """The voxels of a grid that belong to surfaces.

    Attributes:
        density: The grid.
        mask: (X, Y, Z) bool.
    """

    density: Density
    mask: Mask

    @classmethod
    def over(cls, parts: Iterable[Gaussians], low: F64, high: F64) -> Surfaces:
        """Find the surfaces of a core in parts, on a grid over a robust box; `parts` is iterated over twice."""
        resolution = affordable_resolution(high - low, RESOLUTION)
        margin = 2.0 * float((high - low).max()) / resolution
        density = Density.from_parts(parts, low - margin, high + margin, resolution)
        return cls(density, find_surfaces(parts, density, 1.0))

    def lonely(self, means: NDArray[np.float32]) -> Mask:
        """Return which centers (N, 3) are on the grid but not at a surface; none in a scene without surfaces."""
        if not self.mask.any():
            return np.zeros(len(means), bool)
        within = self.density.voxels_of(means)[1]
        return np.asarray(within & ~self.density.look_up(self.mask, means))
