"""Find the opening through which eyes outside look into a space: of each column along a direction, where it ends.

A column is a square of the plane perpendicular to the direction. The opening is the last surface that eyes inside see
along it, such as the ceiling for the direction up. Scene frame and units. This module knows no renderer.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.errors import SceneError
from gsvis.raycast import Tracer
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace

__all__ = ["CONE", "Opening"]

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Mask = NDArray[np.bool_]

CONE = 65.0
"""Largest angle between the direction and a line of sight from outside, degrees."""

_RAYS = 24_576  # rays that find how far the inside reaches
_FINE = 1 / 64  # side of a column as a share of how far most of them reach; at least a voxel
_MOST = 0.9  # these most
_LONGEST = 256  # steps of one column along such a ray
_STEPS = 24  # places along a line of sight at which it is compared with the opening
_RIM = 3  # columns around the opening that hold walls
_REACH = 1.5  # standard deviations at which large Gaussians outside are in the way, too
_HALF = 0.5  # share of the light of a ray that is gone where its surface is


@dataclass(frozen=True, eq=False)
class Opening:
    """The opening of a space, as a field of heights along a direction.

    Attributes:
        axes: (3, 3) rows: two axes of the plane, and the direction; all unit and perpendicular.
        origin: (2,) lowest corner of column (0, 0), in the plane.
        side: Side of a column, scene units.
        open: (X, Y) columns that belong to the space.
        heights: (X, Y) where the column ends, along the direction; of columns outside that of the nearest one.
        away: (X, Y) distance to the nearest open column, scene units.
    """

    axes: F64
    origin: F64
    side: float
    open: Mask
    heights: F64
    away: F64

    @classmethod
    def from_space(cls, space: NavigableSpace, tracer: Tracer, direction: ArrayLike, seed: int = 0) -> Opening:
        """Find the opening of a space by rays from inside.

        Args:
            space: Where eyes inside are.
            tracer: Of the scene.
            direction: (3,) where the eyes outside are, any length.
            seed: Seed of the rays.

        Raises:
            ValueError: If the direction has no length.
            SceneError: If no surface ends the space in this direction: it is open already.
        """
        axes = _axes_along(direction)
        places, side = _reach(space, tracer, np.random.default_rng([seed, 17]))
        places = places @ axes.T
        origin = places[:, :2].min(axis=0) - (_RIM + 1) * side
        shape = np.ceil((places[:, :2].max(axis=0) - origin) / side).astype(int) + _RIM + 1
        columns = np.floor((places[:, :2] - origin) / side).astype(np.int64)
        last = np.full(tuple(shape), -np.inf)
        np.maximum.at(last, (columns[:, 0], columns[:, 1]), places[:, 2])
        cells = np.argwhere(np.isfinite(last))
        starts = np.column_stack([origin + (cells + 0.5) * side, last[tuple(cells.T)]]) @ axes
        depths = _surface_depths(tracer, starts, np.broadcast_to(axes[2], starts.shape))
        heights = np.full(last.shape, np.inf)
        heights[tuple(cells.T)] = last[tuple(cells.T)] + depths
        eyes = np.floor((_voxels(space) @ axes[:2].T - origin) / side).astype(np.int64)
        return cls._from_heights(axes, origin, side, _joined_with(heights, eyes))

    @classmethod
    def _from_heights(cls, axes: F64, origin: F64, side: float, heights: F64) -> Opening:
        """Return the opening of columns with finite heights: smoothed, and continued around them."""
        from scipy import ndimage

        known = np.isfinite(heights)
        if not known.any():
            raise SceneError("nothing covers the space on this side: eyes outside see into it already")
        nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
        smooth = ndimage.median_filter(heights[tuple(nearest)], 3, mode="nearest")
        is_open = ndimage.binary_fill_holes(ndimage.binary_closing(known, np.ones((3, 3), bool)))
        away = side * np.asarray(ndimage.distance_transform_edt(~is_open))
        return cls(axes, origin, side, np.asarray(is_open), np.asarray(smooth), away)

    @property
    def middle(self) -> F64:
        """(3,) middle of the opening, scene frame."""
        cells = np.argwhere(self.open)
        flat = self.origin + (0.5 * (cells.min(axis=0) + cells.max(axis=0)) + 0.5) * self.side
        return np.asarray(np.append(flat, np.median(self.heights[self.open])) @ self.axes)

    @property
    def radius(self) -> float:
        """Half the diagonal of the opening, scene units."""
        cells = np.argwhere(self.open)
        return 0.5 * self.side * float(np.linalg.norm(cells.max(axis=0) - cells.min(axis=0) + 1))

    def blocks(self, g: Gaussians) -> Mask:
        """Return which Gaussians (N,) stand between eyes outside and the space.

        A Gaussian does if a line through its center, or for one beside the space through the ends of its axes, leads
        on into the opening at an angle of at most `CONE` to the direction.
        """
        found = self._is_before(g.means.astype(np.float64))
        beside = np.flatnonzero(~found & ~self.holds(g.means))
        rotations = g[beside].rotations().astype(np.float64)
        reach = _REACH * g.scales[beside].astype(np.float64)
        for axis in range(3):
            for sign in (-1.0, 1.0):
                ends = g.means[beside] + sign * reach[:, axis, None] * rotations[:, :, axis]
                found[beside] |= self._is_before(ends)
        return found

    def holds(self, points: ArrayLike) -> Mask:
        """Return which points (P, 3) lie in the space behind the opening, or in its walls."""
        flat, heights, away = self._look_up(_check.floats("points", points, ("P", 3), np.float64))
        return np.asarray((away <= _RIM * self.side) & (flat <= heights))

    def enters(self, rays_o: ArrayLike, rays_d: ArrayLike) -> Mask:
        """Return which rays (R, 3) from outside enter the space through the opening, not through a wall."""
        starts = _check.floats("rays_o", rays_o, ("R", 3), np.float64) @ self.axes.T
        ways = _check.floats("rays_d", rays_d, ("R", 3), np.float64) @ self.axes.T
        inside = np.zeros(len(starts), bool)
        outside = ways[:, 2] >= 0.0
        heights = self.heights[self.open]
        for level in np.linspace(heights.max(), heights.min() - self.side, _STEPS):
            with np.errstate(divide="ignore", invalid="ignore"):
                along = (level - starts[:, 2]) / ways[:, 2]
            places = np.where(outside[:, None], 0.0, starts + along[:, None] * ways)
            under, away = self._field(places[:, :2])
            reached = ~inside & ~outside & (level <= under)
            inside |= reached & (away == 0.0)
            outside |= reached & (away > 0.0)
        return inside

    def _is_before(self, points: F64) -> Mask:
        """Return which points (P, 3) lie before the opening, within the cone over it."""
        along, heights, away = self._look_up(points)
        return np.asarray((along > heights) & (away <= (along - heights) * np.tan(np.radians(CONE))))

    def _look_up(self, points: F64) -> tuple[F64, F64, F64]:
        """Return of points (P, 3) the place along the direction, the height there, and the distance to the opening."""
        own = points @ self.axes.T
        heights, away = self._field(own[:, :2])
        return own[:, 2], heights, away

    def _field(self, flat: F64) -> tuple[F64, F64]:
        """Return the heights at places (P, 2) of the plane, and the distances to the opening."""
        cells = np.clip(np.floor((flat - self.origin) / self.side), 0, np.array(self.open.shape) - 1).astype(np.int64)
        beyond = np.maximum(self.origin - flat, flat - self.origin - self.side * np.array(self.open.shape)).max(axis=1)
        at = cells[:, 0], cells[:, 1]
        return self.heights[at] - 0.5 * self.side, self.away[at] + np.maximum(beyond, 0.0)


def _voxels(space: NavigableSpace) -> F64:
    """Return the middles (V, 3) of the free voxels of a space."""
    return np.asarray(space.origin + (np.argwhere(space.free) + 0.5) * space.voxel_size)


def _joined_with(heights: F64, eyes: I64) -> F64:
    """Return heights without columns that no way through covered columns joins with those of eyes (V, 2).

    Through windows eyes see columns under eaves and trees, which are no part of the space.
    """
    from scipy import ndimage

    covered = ndimage.binary_opening(np.isfinite(heights), np.ones((2, 2), bool))
    parts, count = ndimage.label(covered)
    own = np.zeros(count + 1, bool)
    own[parts[eyes[:, 0], eyes[:, 1]]] = True
    own[0] = False
    return np.where(own[parts], heights, np.inf)


def _axes_along(direction: ArrayLike) -> F64:
    """Return two perpendicular unit axes and a unit direction, as rows."""
    wanted = _check.floats("direction", direction, (3,), np.float64)
    length = float(np.linalg.norm(wanted))
    if not length > 0.0:
        raise ValueError("direction: expected three numbers that are not all 0, got 0 0 0")
    third = wanted / length
    first = np.eye(3)[int(np.abs(third).argmin())]
    first = first - (first @ third) * third
    first /= np.linalg.norm(first)
    return np.array([first, np.cross(third, first), third])


def _reach(space: NavigableSpace, tracer: Tracer, rng: np.random.Generator) -> tuple[F64, float]:
    """Return places (P, 3) along rays of eyes of a space, until the surface that ends each, and their distance."""
    origins = space.sample_viewpoints(_RAYS, rng)
    directions = rng.normal(size=origins.shape)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    depths = _surface_depths(tracer, origins, directions)
    ended = np.isfinite(depths)
    far = float(np.quantile(depths[ended], _MOST)) if ended.any() else 0.0
    step = max(space.voxel_size, _FINE * far)
    steps = np.where(ended, np.minimum(depths / step, _LONGEST), 0.0).astype(np.int64)
    rays = np.repeat(np.arange(len(steps)), steps)
    along = (np.arange(len(rays)) - np.repeat(np.cumsum(steps) - steps, steps) + 0.5) * step
    return np.concatenate([origins, origins[rays] + along[:, None] * directions[rays]]), step


def _surface_depths(tracer: Tracer, rays_o: F64, rays_d: F64) -> F64:
    """Return where half of the light of each ray is gone, (R,); inf where more than half of it goes on."""
    depths = np.full(len(rays_o), np.inf)
    for start, part in tracer.iter_contributions(rays_o, rays_d):
        sums = np.concatenate([[0.0], np.cumsum(part.weights.astype(np.float64))])
        gone = sums[1:] - np.repeat(sums[part.ray_offsets[:-1]], np.diff(part.ray_offsets))
        hits = np.flatnonzero(gone >= _HALF)
        rays, first = np.unique(part.ray_ids[hits], return_index=True)
        depths[start + rays] = part.depths[hits[first]]
    return depths
