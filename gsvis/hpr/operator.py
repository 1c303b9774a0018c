"""The hidden point removal operator: find the points of a cloud that an eye sees, from their positions alone.

The cloud is flipped about a sphere around the eye. A point is visible if its flip is a vertex of the convex hull of all
flips and the eye. World frame, scene units, float64. Knows no Gaussian; `gaussians.py` gives points an extent.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.hpr._kernels import hull as _kernels
from gsvis.hpr.hull import Hull

__all__ = ["hidden_point_removal"]

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


def hidden_point_removal(points: ArrayLike, viewpoint: ArrayLike, radius: float) -> I64:
    """Return the points that an eye sees.

    The set equals that of Open3D's `PointCloud.hidden_point_removal`, except for these cases:

    - Coincident points: the one of lowest index represents all; Open3D returns any one of them.
    - Points at the viewpoint are visible and hide nothing; Open3D crashes.
    - Points that lie with the viewpoint in one plane or on one line: the operator is applied in that plane or line;
    Open3D
      raises an error.
    - A flip within about 1e-14 radii of the hull of the others: rounding decides. Qhull is used, as in Open3D, but on
    fewer
      points, so that its decision may differ.

    Args:
        points: (N, 3) positions, world frame.
        viewpoint: (3,) the eye.
        radius: Radius of the sphere, scene units, at least the distance of the farthest point. A larger radius
            makes more points visible.

    Returns:
        (K,) int64 indices of the visible points, ascending.

    Raises:
        ValueError: If an array has a wrong shape or holds a value that is not finite, or `radius` is too small.

    References:
        Katz, Tal, Basri, "Direct visibility of point sets", SIGGRAPH 2007, section 3.
    """
    cloud = _check.floats("points", points, ("N", 3), np.float64)
    eye = _check.floats("viewpoint", viewpoint, (3,), np.float64)
    flips, elsewhere = flip_points(cloud, eye, radius)
    seen = hull_vertices(flips)
    if elsewhere is None:
        return seen
    at_eye = np.setdiff1d(np.arange(len(cloud)), elsewhere)
    return np.union1d(elsewhere[seen], at_eye)


def flip_points(points: F64, eye: F64, radius: float) -> tuple[F64, I64 | None]:
    """Return flips (M, 3) of the points not at the eye, relative to the eye, and their indices (None: all).

    Raises:
        ValueError: If `radius` is not finite or below the distance of the farthest point.
    """
    lengths = np.empty(len(points))
    _kernels.distances(points, eye, lengths)
    farthest = float(lengths.max(initial=0.0))
    if isinstance(radius, bool) or not isinstance(radius, int | float | np.floating | np.integer):
        raise ValueError(f"radius: expected a number, got {radius!r}")
    if not (np.isfinite(radius) and radius >= farthest and radius > 0.0):
        raise ValueError(
            f"radius: expected a finite radius of at least the distance of the farthest point, {farthest:.6g}, got "
            f"{radius!r}; remove outliers or give a larger one"
        )
    elsewhere = None
    if len(points) and lengths.min() == 0.0:
        elsewhere = np.flatnonzero(lengths > 0.0)
        points = points[elsewhere]
        lengths = lengths[elsewhere]
    flips = np.empty_like(points)
    _kernels.flip(points, eye, lengths, float(radius), flips)
    return flips, elsewhere


def hull_vertices(flips: F64) -> I64:
    """Return the flips (M, 3) that are vertices of the convex hull of all of them and the origin; ascending."""
    if len(flips) < 4:
        return _by_qhull(flips, np.arange(len(flips)))
    hull, candidates = Hull.around(flips)
    if hull is not None:
        return hull.vertices
    return _by_qhull(flips, candidates)


def _by_qhull(flips: F64, candidates: I64) -> I64:
    """Return `hull_vertices` among the candidates, by Qhull; flat input is solved in its plane or line."""
    from scipy.spatial import ConvexHull, QhullError  # slow to import, seldom needed

    distinct, first = np.unique(flips[candidates], axis=0, return_index=True)
    lowest = candidates[first]  # np.unique returns the first of equal rows, and candidates ascend
    places = np.concatenate([distinct, np.zeros((1, 3))])
    try:
        vertices = ConvexHull(places).vertices
    except QhullError:
        vertices = _flat(places)
    return np.sort(lowest[vertices[vertices < len(lowest)]])


def _flat(places: F64) -> I64:
    """Return the vertices of the hull of places (M, 3), in the plane or line that they span with the last place."""
    from scipy.spatial import ConvexHull, QhullError

    if len(places) == 1:
        return np.zeros(0, np.int64)
    _, extents, axes = np.linalg.svd(places, full_matrices=False)
    if len(extents) > 1 and extents[1] > 1e-12 * extents[0]:
        try:
            return np.asarray(ConvexHull(places @ axes[:2].T).vertices, np.int64)
        except QhullError:
            pass
    along = places @ axes[0]
    return np.unique([along.argmin(), along.argmax()])
