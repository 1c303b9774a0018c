"""Hidden point removal in its shortest form: flip everything, take the hull of everything. The oracle of the tests."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

__all__ = ["hidden_point_removal_reference"]


def hidden_point_removal_reference(
    points: NDArray[np.float64], viewpoint: NDArray[np.float64], radius: float
) -> NDArray[np.int64]:
    """The points whose spherical flip is a vertex of the convex hull of all flips and the eye.

    Args:
        points: (N, 3), none of them at the viewpoint, not all in one plane with it.
        viewpoint: (3,).
        radius: Of the sphere the points are flipped about.

    Returns:
        (K,) int64, rising.

    References:
        Katz, Tal, Basri, "Direct visibility of point sets", SIGGRAPH 2007, section 3.
    """
    toward = points - viewpoint
    x, y, z = toward.T
    length = np.sqrt((x * x + y * y) + z * z)[:, None]
    flipped = toward + 2.0 * (radius - length) * toward / length
    vertices = ConvexHull(np.concatenate([flipped, np.zeros((1, 3))])).vertices
    return np.sort(vertices[vertices < len(points)]).astype(np.int64)
