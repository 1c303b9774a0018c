"""Hidden point removal for Gaussians, with extent, orientation and opacity, not only centers.

A Gaussian takes part of the light over part of the sky. Therefore the places where light is spent are flipped, one for
each cell of a cubemap around the eye, instead of the centers. A Gaussian is visible if its nearest point lies in front
of the hull of these places. World frame, scene units.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.hpr._kernels import spent as _kernels
from gsvis.hpr._kernels.hull import sort_by_cell
from gsvis.hpr.hull import Hull
from gsvis.raycast import MIN_ALPHA, TAU
from gsvis.scene.gaussians import Gaussians

__all__ = ["ON_HULL", "OcclusionHull", "visible_gaussians"]

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
I64 = NDArray[np.int64]

ON_HULL = 1.0
"""Largest nearness of a visible Gaussian: its nearest point lies on the hull."""

_BINS = 192
"""Number of depth bins in which a cell sums optical thickness."""
_MOST_CELLS = 256
"""Largest number of cells along a side of the cubemap's faces."""
_SKY = 1e3
"""Distance of the sky over that of the farthest center."""
_AT_SKY = 0.999
"""Share of the distance of the sky beyond which an eye sees without end."""
_DARK = 1e-6
"""Distance to which an eye sees in the dark, over the median distance of the centers; 0 cannot be flipped."""
_NOISE = 1e-9
"""Relative noise added to flips, so that no four of them lie in one plane: cells are symmetric and depths repeat."""


@dataclass(frozen=True, eq=False)
class OcclusionHull:
    """The distance to which an eye sees among Gaussians, in every direction.

    Attributes:
        viewpoint: (3,) the eye.
        size: Cells along a side of the cubemap's faces.
        depths: (6 size^2,) distance to which the eye sees in the direction of each cell's center; `inf` if light is
            never spent. Cells lie row by row, faces in the order +x, -x, +y, -y, +z, -z.
        gaussians: The scene.
    """

    viewpoint: F64
    size: int
    depths: F64
    gaussians: Gaussians
    _toward: F64
    _shapes: F64

    @classmethod
    def from_scene(
        cls, g: Gaussians, viewpoint: ArrayLike, *, size: int = 64, spent: float = TAU, margin: float = 0.1
    ) -> OcclusionHull:
        """Find where light is spent around an eye.

        Each Gaussian adds its optical thickness to the cells it covers, at its depth: small ones by their solid angle,
        larger ones by their alpha on the ray through the cell's center. The occluding point of a cell is at the depth
        at which its transmittance falls to `spent`. These points are flipped exponentially, d -> d^gamma with gamma
        slightly below 0 (a spherical flip would treat near and far unequally). The hull of the flips defines how far
        the eye sees. It bridges gaps narrower than `margin` allows and never hides a cell's own occluding point.

        Args:
            g: N Gaussians.
            viewpoint: (3,) the eye; Gaussians that contain it dim every direction.
            size: Cells along a side of the cubemap's faces, 4 to 256.
            spent: Transmittance in (0, 1) that counts as 0.
            margin: How far the hull of points at one distance may lie behind them between neighboring cells, as a
                share of the distance, in (0, 1]. It has the role of the radius of the spherical flip.

        Raises:
            ValueError: If an argument is out of range.

        References:
            Katz, Tal, "On the visibility of point clouds", ICCV 2015 (exponential kernel); SRBF-Gaussian, section 6.2.
        """
        eye = _check.floats("viewpoint", viewpoint, (3,), np.float64)
        if not 4 <= _check.positive_int("size", size) <= _MOST_CELLS:
            raise ValueError(f"size: expected 4 to {_MOST_CELLS} cells, got {size}")
        if not 0.0 < spent < 1.0:
            raise ValueError(f"spent: expected a transmittance in (0, 1), got {spent!r}")
        if not 0.0 < margin <= 1.0:
            raise ValueError(f"margin: expected a share in (0, 1], got {margin!r}")
        toward = np.empty((len(g), 3))
        shapes = np.empty((len(g), 5))
        faces = np.empty(len(g), np.int64)
        _kernels.shapes_from_eye(g.means, g.quats, g.scales, g.opacities, MIN_ALPHA, eye, toward, faces, shapes)
        depths = _light_ends(g, toward, shapes, faces, size, spent)
        return cls(eye, size, _through_hull(depths, size, margin, shapes[:, 0]), g, toward, shapes)

    @classmethod
    def from_depths(
        cls, g: Gaussians, viewpoint: ArrayLike, depths: ArrayLike, *, margin: float = 0.1
    ) -> OcclusionHull:
        """Build the hull from known depths at which light is spent, such as those of a z-buffer.

        Args:
            g: N Gaussians to query; they hide nothing.
            viewpoint: (3,) the eye.
            depths: (6, size, size) distances at which light is spent, `inf` where it is not.
            margin: As in `from_scene`.

        Raises:
            ValueError: If an argument is out of range.
        """
        eye = _check.floats("viewpoint", viewpoint, (3,), np.float64)
        ends = _check.floats("depths", depths, (6, "S", "S"), np.float64, finite=False)
        if not 0.0 < margin <= 1.0:
            raise ValueError(f"margin: expected a share in (0, 1], got {margin!r}")
        toward = np.empty((len(g), 3))
        shapes = np.empty((len(g), 5))
        faces = np.empty(len(g), np.int64)
        _kernels.shapes_from_eye(g.means, g.quats, g.scales, g.opacities, MIN_ALPHA, eye, toward, faces, shapes)
        size = ends.shape[1]
        return cls(eye, size, _through_hull(ends.reshape(-1), size, margin, shapes[:, 0]), g, toward, shapes)

    def nearness(self, ids: ArrayLike | None = None) -> F32:
        """Compute how far in front of the hull, or behind it, each Gaussian lies.

        Args:
            ids: (M,) Gaussians to test; None means all N.

        Returns:
            (M,) distance of the nearest point where alpha reaches 1/255 over the distance to which the eye sees there,
            the smallest over the center and, for large ones, the ends of the axes. Visible up to 1; a larger value is
            more certainly hidden. 0 around the eye, `inf` for Gaussians too faint to be visible.

        Raises:
            ValueError: If an id is not in [0, N).
        """
        g = self.gaussians
        arrays: list[NDArray[Any]] = [self._toward, g.quats, g.scales, g.opacities, self._shapes]
        if ids is not None:
            chosen = _check.integers("ids", ids, ("M",))
            _check.in_range("ids", chosen, 0, len(g) - 1)
            arrays = [np.ascontiguousarray(a[chosen]) for a in arrays]
        out = np.empty(len(arrays[0]), np.float32)
        toward, *content, shapes = arrays
        _kernels.nearness(toward, *_check.read_only(*content), shapes, MIN_ALPHA, self.depths, self.size, out)
        return out


def visible_gaussians(
    g: Gaussians,
    viewpoint: ArrayLike,
    *,
    ids: ArrayLike | None = None,
    size: int = 64,
    spent: float = TAU,
    margin: float = 0.1,
) -> I64:
    """Return the Gaussians that an eye sees, by hidden point removal.

    All Gaussians occlude; `ids` only selects the ones to test.

    Args:
        g: N Gaussians.
        viewpoint: (3,) the eye. Gaussians that contain it are visible, and dim every direction.
        ids: (M,) Gaussians to test; None means all N.
        size: Cells along a side of the cubemap's faces, 4 to 256.
        spent: Transmittance in (0, 1) that counts as 0.
        margin: Margin of the hull; see `OcclusionHull.from_scene`.

    Returns:
        (K,) int64 indices of the visible Gaussians, ascending. An empty scene gives an empty set.

    Raises:
        ValueError: If an argument is out of range.
    """
    hull = OcclusionHull.from_scene(g, viewpoint, size=size, spent=spent, margin=margin)
    near = np.flatnonzero(hull.nearness(ids) <= ON_HULL)
    return near if ids is None else np.unique(_check.integers("ids", ids, ("M",))[near])


def _light_ends(g: Gaussians, toward: F64, shapes: F64, faces: I64, size: int, spent: float) -> F64:
    """Return the (6 size^2,) distance at which light is spent in each cell; `inf` where it is never spent."""
    distances = shapes[:, 0][shapes[:, 0] > 0.0]  # faint Gaussians included: the bins must not depend on opacity
    if len(distances) == 0:
        return np.full(6 * size * size, np.inf)
    sample = distances[:: max(len(distances) // 20_000, 1)]
    nearest = 0.5 * np.quantile(sample, 0.001)
    farthest = 1.01 * np.quantile(sample, 0.999)
    steps = (_BINS - 3) / np.log(farthest / nearest)
    order = np.empty(len(g), np.int64)
    begins = sort_by_cell(faces, 8, order)
    thickness = np.zeros((6 * size * size, _BINS), np.float32)
    arrays = toward, g.quats, g.scales, g.opacities, shapes, order, begins
    _kernels.thicken(*arrays, size, nearest, steps, thickness)
    depths = np.empty(6 * size * size)
    _kernels.find_spent_depths(thickness, -np.log(spent), nearest, steps, depths)
    return depths


def _through_hull(depths: F64, size: int, margin: float, distances: F64) -> F64:
    """Return the distances (6 size^2,) to which the hull of the flipped ends of light lets the eye see.

    Where light is never spent, a sky is flipped. Its distance is `_SKY` times that of the farthest center; `distances`
    (N,) are those of the centers. It must not depend on where light is spent: more opacity would bring the sky nearer,
    and a nearer sky shows more.
    """
    away = distances[distances > 0.0]
    if len(away) == 0 or not depths[np.isfinite(depths)].any():  # nothing to test, open everywhere, or total darkness
        return depths
    directions = np.empty((len(depths), 3))
    _kernels.centers_of_cells(size, directions)
    gamma = -((np.pi / (2.0 * size)) ** 2) / (8.0 * margin)
    sky = _SKY * float(away.max())
    dark = _DARK * float(np.median(away))
    flips = directions * np.clip(depths, dark, sky)[:, None] ** gamma
    flips *= 1.0 + _NOISE * np.random.default_rng(0).random((len(flips), 1))
    hull, _ = Hull.around(flips, exact=False)
    if hull is None:
        return depths
    reach = hull.radial(directions)
    with np.errstate(divide="ignore", over="ignore"):
        seen = np.where(reach > 0.0, reach, 0.0) ** (1.0 / gamma)
    return np.where(seen >= _AT_SKY * sky, np.inf, np.maximum(seen, 0.0))
