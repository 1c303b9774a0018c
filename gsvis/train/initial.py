"""Create the initial Gaussians of training from photos: at the points of a reconstruction, or at random points.

World frame and units are those of the cameras. Nothing here reads an image.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.errors import SceneError
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.points import PointCloud
from gsvis.scene.sh import SH_C0

__all__ = ["gaussians_from_points", "random_points"]

F64 = NDArray[np.float64]

_NEIGHBORS = 3
_OPACITY = 0.1
_LEAST_SCALE = 1e-7  # share of the cloud's size that float32 still resolves
_ROUNDS = 200


def gaussians_from_points(points: PointCloud, sh_degree: int = 0) -> Gaussians:
    """Return a faint ball at each point, sized by the distance to its neighbors.

    The scale is the root mean square distance to the 3 nearest points at different places, or fewer if there are fewer.
    The opacity is 0.1. The color is that of the point, from every direction.

    Args:
        points: N points, at 2 places or more.
        sh_degree: Degree of the colors; higher coefficients are 0. Training raises the degree from 0 by itself.

    Returns:
        N Gaussians in the order of the points.

    Raises:
        ValueError: If all points lie at one place, there are none, or the degree is not 0 to 3.

    References:
        Kerbl et al., "3D Gaussian splatting for real-time radiance field rendering", TOG 2023, section 5.1 and the
        authors' code, which treats duplicates as neighbors at distance 0.

    Examples:
        >>> start = gaussians_from_points(PointCloud([[0, 0, 0], [3, 0, 0], [0, 4, 0]]))
        >>> float(start.scales[0, 0])  # root of (9 + 16) / 2
        3.535534
    """
    from scipy.spatial import cKDTree  # slow to import

    if sh_degree not in (0, 1, 2, 3):
        raise ValueError(f"sh_degree: expected 0, 1, 2 or 3, got {sh_degree!r}")
    places, of_point = np.unique(points.means.astype(np.float64), axis=0, return_inverse=True)
    if len(places) < 2:
        got = f"{len(points):,} at {len(places)}"
        raise ValueError(f"points: expected points at 2 places or more, got {got}; use random_points")
    near, _ = cKDTree(places).query(places, k=min(_NEIGHBORS, len(places) - 1) + 1)
    apart = np.sqrt((near[:, 1:] ** 2).mean(axis=1))  # the first is the point itself
    size = float(np.ptp(places, axis=0).max())
    scales = np.maximum(apart, _LEAST_SCALE * size)[of_point.reshape(-1)]
    n = len(points)
    quats = np.zeros((n, 4), np.float32)
    quats[:, 0] = 1.0
    return Gaussians(
        points.means,
        quats,
        np.repeat(scales[:, None], 3, axis=1),
        np.full(n, _OPACITY, np.float32),
        ((points.colors - 0.5) / SH_C0)[:, None, :],
        np.zeros((n, (sh_degree + 1) ** 2 - 1, 3), np.float32),
    )


def random_points(cameras: Cameras, count: int, rng: np.random.Generator) -> PointCloud:
    """Return random points for a reconstruction without points: gray, in the box that cameras look at.

    The box holds the viewpoints and, from each, all points up to twice the distance of the point nearest to all lines
    of sight. That distance is at least the distance between cameras, in case they look past each other.

    Args:
        cameras: C cameras, C >= 1.
        count: N, number of points.
        rng: Source of randomness.

    Returns:
        N points, each inside the image of at least one camera.

    Raises:
        ValueError: If there is no camera, or `count` is below 1.
        SceneError: If the cameras see almost none of the box.

    Examples:
        >>> around = Cameras.orbit((0, 0, 0), 2.0, 8)
        >>> random_points(around, 100, np.random.default_rng(0))
        PointCloud(100)
    """
    _check.positive_int("count", count)
    if len(cameras) == 0:
        raise ValueError("cameras: expected at least one, got none")
    low, high = _box_of(cameras)
    kept: list[F64] = []
    have = 0
    for _ in range(_ROUNDS):
        drawn = rng.uniform(low, high, (count, 3))
        kept.append(drawn[_is_seen(cameras, drawn)])
        have += len(kept[-1])
        if have >= count:
            return PointCloud(np.concatenate(kept)[:count])
    raise SceneError(f"the {len(cameras):,} cameras see almost none of the box in front of them; check their poses")


def _box_of(cameras: Cameras) -> tuple[F64, F64]:
    """Return the lowest and highest corner of the box, (3,) each."""
    eyes = cameras.viewpoints
    axes = cameras.forwards
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]  # removes the part along the line of sight
    focus, *_ = np.linalg.lstsq(across.sum(axis=0), np.einsum("cij,cj->i", across, eyes), rcond=1e-6)
    spread = float(np.linalg.norm(eyes - eyes.mean(axis=0), axis=1).max()) or 1.0
    far = np.maximum(np.einsum("ci,ci->c", focus - eyes, axes), spread)
    corners = np.concatenate([eyes, eyes + 2.0 * far[:, None] * axes])
    middle = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
    half = 0.5 * np.ptp(corners, axis=0)
    half = np.maximum(half, 0.25 * half.max())  # cameras on a line or in a plane also see beside it
    return middle - half, middle + half


def _is_seen(cameras: Cameras, points: F64) -> NDArray[np.bool_]:
    """Return a mask (N,): whether each point is inside the image of at least one camera."""
    seen = np.zeros(len(points), bool)
    for pose, k in zip(cameras.viewmats, cameras.Ks, strict=True):
        rest = np.flatnonzero(~seen)
        local = points[rest] @ pose[:3, :3].T + pose[:3, 3]
        with np.errstate(all="ignore"):
            x, y = (local @ k[:2].T / local[:, 2:]).T
        inside = (local[:, 2] > 0) & (x >= 0) & (x < cameras.width) & (y >= 0) & (y < cameras.height)
        seen[rest[inside]] = True
    return seen
