"""A plan of a scene: what lies below the eyes, seen straight from above, and a place on it for every point.

From above means along the up axis, whatever direction of the scene it is. Pixels of a plan have equal sides, x to the
right and y down. Needs no matplotlib.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis.render import rasterize
from gsvis.scene.axes import describe_direction
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace

__all__ = ["Plan", "axes_from_above", "free_points", "nice_length"]

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

_TAIL = 0.02  # of the centers left out at each end of each side
_WIDER = 0.25  # how far around the eyes a plan reaches for the scene, in the size of what the eyes fill
_MARGIN = 0.04
_FAR = 40.0  # distance of the camera above a plan, in its side: lines of sight are parallel within 1.5 degrees
_LEAST_BELOW = 0.2  # of the Gaussians in the plan; if fewer lie below the eyes, nothing is cut away
_WIDEST = 0.2  # greatest standard deviation of what is drawn, in the side of the plan: skies would cover it
_ROOM_CUT = 0.6  # share of the eyes in rooms that lie below the cut
_VOXELS = 200_000  # free voxels that are looked at


@dataclass(frozen=True, eq=False)
class Plan:
    """The frame of a plan.

    Attributes:
        right: (3,) unit vector to the right of the plan, scene frame.
        onward: (3,) unit vector to its top; right x onward is up.
        up: (3,) unit up axis.
        low: (2,) lowest corner along these two, scene units.
        side: Length of a side, scene units.
        cut: Height along up above which nothing is drawn; infinite if nothing is cut away.
        pixels: Pixels along a side.
    """

    right: F64
    onward: F64
    up: F64
    low: F64
    side: float
    cut: float
    pixels: int

    @classmethod
    def over(
        cls,
        g: Gaussians,
        space: NavigableSpace,
        pixels: int,
        *,
        more: ArrayLike = (),
        cut_by: NavigableSpace | None = None,
    ) -> Plan:
        """Return the plan of a scene and of the eyes in it, cut open at the height of the eyes in rooms.

        Args:
            g: The scene, N > 0.
            space: Where eyes may be.
            pixels: Pixels along a side.
            more: (P, 3) more points that have to lie on the plan.
            cut_by: The space at whose eyes the plan is cut open; `space` by default.
        """
        up = space.up
        right, onward = axes_from_above(up)
        frame = np.stack([right, onward])
        eyes = free_points(space)
        points = np.concatenate([eyes, np.reshape(np.asarray(more, np.float64), (-1, 3))]) @ frame.T
        low = points.min(axis=0)
        high = points.max(axis=0)
        reach = _WIDER * float((high - low).max())
        box = np.quantile(g.means.astype(np.float64) @ frame.T, [_TAIL, 1.0 - _TAIL], axis=0)
        low = np.minimum(low, np.maximum(box[0], low - reach))
        high = np.maximum(high, np.minimum(box[1], high + reach))
        side = (1.0 + 2.0 * _MARGIN) * max(float((high - low).max()), 1e-9)
        return cls(right, onward, up, 0.5 * (low + high) - 0.5 * side, side, _cut(cut_by or space, up), pixels)

    def places(self, points: ArrayLike) -> F64:
        """Return (P, 2) pixels of points (P, 3), column and row."""
        across = np.asarray(points, np.float64) @ np.stack([self.right, self.onward]).T
        columns, rows = ((across - self.low) * (self.pixels / self.side)).T
        return np.stack([columns, self.pixels - rows], axis=1)

    def draw(self, g: Gaussians, background: tuple[float, float, float]) -> NDArray[np.float32]:
        """Return (H, W, 3) what lies below the cut, from above, in the colors of the scene."""
        means = g.means.astype(np.float64)
        columns, rows = self.places(means).T
        inside = (columns >= 0) & (columns < self.pixels) & (rows >= 0) & (rows < self.pixels)
        inside &= g.scales.max(axis=1) <= _WIDEST * self.side
        heights = means @ self.up
        below = inside & (heights <= self.cut)
        if np.count_nonzero(below) < _LEAST_BELOW * np.count_nonzero(inside):
            below = inside
        if not below.any():
            return np.full((self.pixels, self.pixels, 3), background, np.float32)
        middle = self.low + 0.5 * self.side
        ground = middle[0] * self.right + middle[1] * self.onward + float(np.median(heights[below])) * self.up
        fov = float(np.degrees(2.0 * np.arctan(0.5 / _FAR)))
        eye = ground + _FAR * self.side * self.up
        size = self.pixels
        camera = Cameras.look_at([eye], ground, up=self.onward, width=size, height=size, fov=fov)
        drawn = rasterize(g[below], camera, backend="cpu", background=background, sh_degree=0)
        return np.asarray(np.clip(drawn.images[0], 0.0, 1.0), np.float32)

    def covered(self, space: NavigableSpace) -> Mask:
        """Return (H, W) where an eye may be above or below."""
        from scipy import ndimage

        cell = 1.5 * space.voxel_size
        count = int(np.clip(np.ceil(self.side / cell), 8, self.pixels))
        columns, rows = np.clip(self.places(free_points(space)) * (count / self.pixels), 0, count - 1).astype(int).T
        coarse = np.zeros((count, count), np.float32)
        coarse[rows, columns] = 1.0
        fine = ndimage.zoom(coarse, self.pixels / count, order=1, mode="nearest", grid_mode=True)
        return np.asarray(ndimage.gaussian_filter(fine, 0.5 * self.pixels / count) > 0.45, bool)

    def explain(self) -> str:
        """Return how to read the plan, in a line."""
        cut = ", cut open at the height of eyes" if np.isfinite(self.cut) else ""
        names = (describe_direction(self.right), describe_direction(self.onward))
        axes = "".join(
            f"; {name} {where}"
            for name, where in zip(names, ("to the right", "up the page"), strict=True)
            if len(name) == 2
        )
        return f"Seen from above{cut}{axes}"


def axes_from_above(up: F64) -> tuple[F64, F64]:
    """Return unit vectors to the right and to the top of a page that shows a scene from above.

    The first is an axis of the scene, or the nearest to one, so that rooms lie straight on the page.

    Args:
        up: (3,) unit up axis.
    """
    level = np.eye(3)[np.abs(up).argsort(kind="stable")[0]]
    right = level - (level @ up) * up
    right /= np.linalg.norm(right)
    return right, np.cross(up, right)


def _cut(space: NavigableSpace, up: F64) -> float:
    """Return the height above which a plan shows nothing: ceilings, and what hangs over the eyes of an open place."""
    if space.kind.kind == "object":
        return np.inf
    share = _ROOM_CUT if space.kind.kind == "rooms" else 1.0
    return float(np.quantile(free_points(space) @ up, share))


def free_points(space: NavigableSpace) -> F64:
    """Return (P, 3) the middles of free voxels, of at most 200,000, evenly spread; scene frame."""
    flat = np.flatnonzero(space.free)
    if len(flat) > _VOXELS:
        flat = flat[np.random.default_rng(0).choice(len(flat), _VOXELS, replace=False)]
    index = np.stack(np.unravel_index(flat, space.free.shape), axis=1)
    return np.asarray(space.origin + space.voxel_size * (index + 0.5))


def nice_length(most: float) -> float:
    """Return the largest of 1, 2 and 5 times a power of ten that is no more than a length above 0.

    Examples:
        >>> nice_length(37.0), nice_length(0.0501)
        (20.0, 0.05)
    """
    power = 10.0 ** np.floor(np.log10(most))
    return float(max(step for step in (1.0, 2.0, 5.0) if step * power <= most * (1.0 + 1e-9)) * power)
