"""Find by the Gaussians alone which of them are far outside, hazy, large, or in lonely groups.

Scene frame and units. A grid of optical depths finds surfaces; groups of few Gaussians that hang alone are none. No eye
is known here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis.errors import SceneError
from gsvis.scene.density import Density
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.inspection import FLOATER_EXTENT, MIN_ALPHA

__all__ = ["FEW", "RESOLUTION", "Shape", "affordable_resolution", "far_from", "find_surfaces"]

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
    """What the Gaussians alone show, before any eye is known.

    Attributes:
        far: (N,) the center lies outside 5 times the robust box.
        hazy: (N,) large in all directions and faint.
        large: (N,) the middle standard deviation is at least 1% of the longest side of the robust box; none in a
            scene that lies in one point.
        lonely: (N,) the center is not at a surface, but in a small group of few Gaussians, or where they are thin;
            none in a scene without any surface.
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
        low, high = g[can_be_seen].bounds(0.98)
        half = 0.5 * (high - low)
        far = far_from(g.means, low, high)
        least, mid, _ = np.sort(g.scales, axis=1).T
        large = (mid >= LARGE * 2.0 * half.max()) & bool(half.max() > 0.0)
        hazy = large & (least >= ROUND * mid) & (g.opacities <= FAINT)
        core = ~(far | hazy) & can_be_seen
        lonely = np.zeros(len(g), bool)
        if half.max() > 0.0 and core.any():
            lonely[core] = _find_lonely(g[core], low, high)
        return cls(np.asarray(far), np.asarray(hazy), np.asarray(large), lonely, low, high)

    @property
    def core(self) -> Mask:
        """(N,) Gaussians that hide things: neither far outside nor hazy."""
        return ~(self.far | self.hazy)

    @property
    def surfaces(self) -> Mask:
        """(N,) Gaussians between which navigable space is to be found: the core without lonely groups."""
        return self.core & ~self.lonely


def far_from(means: NDArray[np.float32], low: F64, high: F64) -> Mask:
    """Return which centers (N, 3) lie outside 5 times a robust box; none if the box is a point."""
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    far = np.any(np.abs(means - middle) > FLOATER_EXTENT * np.maximum(half, 0.02 * half.max()), axis=1)
    return np.asarray(far & bool(half.max() > 0.0))


def affordable_resolution(sides: F64, resolution: int) -> int:
    """Return the voxels along the longest side, `resolution` or fewer, of a grid of at most 16 million voxels.

    Args:
        sides: (3,) sides of the box, the longest above 0.
        resolution: Voxels along the longest side that are wanted.
    """
    shares = np.maximum(sides / sides.max(), 1.0 / resolution)
    return int(np.clip(np.cbrt(_VOXELS / np.prod(shares)), 8, resolution))


def find_surfaces(core: Gaussians, density: Density, strength: float) -> tuple[Mask, Mask]:
    """Return which voxels belong to surfaces, and which Gaussians have their center in none of them.

    A voxel that takes much light belongs to a surface, unless its group is small and holds few centers.

    Args:
        core: (N) Gaussians of which the grid was made.
        density: The grid, (X, Y, Z) voxels.
        strength: How readily a group is too small, above 0.

    Returns:
        (X, Y, Z) bool, voxels of surfaces; (N,) bool, Gaussians on the grid but at no surface.
    """
    from scipy import ndimage

    labels, count = ndimage.label(density.depth >= SURFACE * strength, np.ones((3, 3, 3), bool))
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    voxels, within = density.voxels_of(core.means)
    members = labels[tuple(voxels.T)]
    held = np.bincount(members[within], minlength=count + 1)
    is_surface = (held > FEW * strength) | (sizes > SMALL * strength)
    is_surface[0] = False
    return is_surface[labels], np.asarray(within & ~is_surface[members])


def _find_lonely(core: Gaussians, low: F64, high: F64) -> Mask:
    """Return which Gaussians of a core are at no surface, on a grid over the robust box; none if there is none."""
    resolution = affordable_resolution(high - low, RESOLUTION)
    margin = 2.0 * float((high - low).max()) / resolution
    density = Density.from_scene(core, low - margin, high + margin, resolution)
    surface, lonely = find_surfaces(core, density, 1.0)
    return lonely if surface.any() else np.zeros(len(core), bool)
