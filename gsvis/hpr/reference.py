"""Reference implementations of this room, short and slow, to which the tests compare.

Hidden point removal: flip everything, take the hull of everything. The z-buffer: every Gaussian on every pixel.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsvis.scene.gaussians import Gaussians

__all__ = ["hidden_point_removal_reference", "look_around_reference"]


def hidden_point_removal_reference(
    points: NDArray[np.float64], viewpoint: NDArray[np.float64], radius: float
) -> NDArray[np.int64]:
    """Return the points whose spherical flip is a vertex of the convex hull of all flips and the eye.

    Args:
        points: (N, 3), none of them at the viewpoint, not all in one plane with it.
        viewpoint: (3,).
        radius: Radius of the sphere of the flip.

    Returns:
        (K,) int64, ascending.

    References:
        Katz, Tal, Basri, "Direct visibility of point sets", SIGGRAPH 2007, section 3.
    """
    from scipy.spatial import ConvexHull  # slow to import, seldom needed

    toward = points - viewpoint
    x, y, z = toward.T
    length = np.sqrt((x * x + y * y) + z * z)[:, None]
    flipped = toward + 2.0 * (radius - length) * toward / length
    vertices = ConvexHull(np.concatenate([flipped, np.zeros((1, 3))])).vertices
    return np.sort(vertices[vertices < len(points)]).astype(np.int64)


def look_around_reference(
    g: Gaussians, viewpoint: NDArray[np.float64], size: int, spent: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Compute what an eye sees by splatting every Gaussian on every pixel of the six faces, nearest center first.

    Args:
        g: N Gaussians, all at different distances.
        viewpoint: (3,) the eye, world frame.
        size: Pixels along a side of the faces.
        spent: Transmittance below which light counts as spent.

    Returns:
        Weight of each, largest share of a pixel's light that it takes times the root of the share of its blurred splat
        that it covers (N,), largest light in front over the covered pixels (N,), and
        depths (6, size, size) at which light is spent.
    """
    weights = np.zeros(len(g))
    lights = np.zeros(len(g))
    depths = np.full((6, size, size), np.inf)
    left = np.ones((6, size, size))
    toward = g.means.astype(np.float64) - viewpoint
    far = np.linalg.norm(toward, axis=1)
    centers = np.arange(size) + 0.5
    for i in np.argsort(far):
        for face in range(6):
            axis = face // 2
            u, v = (a for a in range(3) if a != axis)
            frame = np.zeros((3, 3))  # rows: columns of the image, rows of the image, forward
            frame[0, u] = 1.0
            frame[1, v] = 1.0
            frame[2, axis] = 1.0 if face % 2 == 0 else -1.0
            x, y, z = frame @ toward[i]
            if z <= 0.01:
                continue
            tx, ty = np.clip([x / z, y / z], -1.3, 1.3)
            focal = size / 2.0
            jacobian = focal / z * np.array([[1.0, 0.0, -tx], [0.0, 1.0, -ty]]) @ frame
            sharp = jacobian @ g.covars()[i] @ jacobian.T
            blurred = sharp + 0.3 * np.eye(2)
            cover = np.sqrt(np.linalg.det(sharp) / np.linalg.det(blurred))
            conic = np.linalg.inv(blurred)
            dx, dy = np.meshgrid(centers - focal * (x / z + 1.0), centers - focal * (y / z + 1.0))
            power = conic[0, 0] * dx * dx + 2.0 * conic[0, 1] * dx * dy + conic[1, 1] * dy * dy
            alpha = g.opacities[i] * np.exp(-0.5 * power)
            alpha = np.where(alpha >= 1.0 / 255.0, np.minimum(alpha, 0.999), 0.0)
            weights[i] = max(weights[i], np.sqrt(cover) * (alpha * left[face]).max())
            lights[i] = max(lights[i], np.where(alpha > 0.0, left[face], 0.0).max())
            after = left[face] * (1.0 - cover * alpha)
            depths[face][(after < spent) & (left[face] >= spent)] = far[i]
            left[face] = after
    return weights, lights, depths
