"""Compute direction sets: from which of the 80 faces of the once-subdivided icosahedron each Gaussian is visible.

Directions point from the Gaussian to the eye, world frame. A set is 10 bytes: bit f % 8 of byte f // 8 is face f. Sets
are gathered from viewpoints, or traced outward from the Gaussians into navigable space.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.progress import Progress, silent
from gsvis.raycast._kernels import directions as _kernels_directions
from gsvis.raycast.tracer import TAU, Tracer
from gsvis.raycast.visible import visible_in
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.icosphere import NUM_FACES, face_directions, face_shares, icosphere
from gsvis.scene.navigable import NavigableSpace

__all__ = [
    "NUM_FACES",
    "direction_cdf",
    "direction_fractions",
    "directions_from_cameras",
    "face_directions",
    "face_of",
    "icosphere_faces",
    "jaccard",
    "seen_directions",
    "seen_from_space",
    "solid_angle_fractions",
    "trace_directions",
]

_CHUNK = 4096

U8 = NDArray[np.uint8]
F64 = NDArray[np.float64]


def icosphere_faces() -> F64:
    """Return (80, 3, 3) unit corners of the faces, counter-clockwise seen from outside."""
    vertices, faces = icosphere(1)
    return np.asarray(vertices[faces])


def face_of(directions: ArrayLike) -> NDArray[np.int64]:
    """Return the face that holds each direction.

    Args:
        directions: (D, 3) from the Gaussian to the eye, any non-zero length.

    Returns:
        (D,) int64 in [0, 80). A direction on an edge always belongs to the same one of its faces.

    Raises:
        ValueError: If a direction is zero or not finite.
    """
    unit = _check.unit_vectors("directions", directions)
    faces = np.empty(len(unit), np.int64)
    _kernels_directions.faces_of(unit, *face_planes(), faces)
    return faces


def seen_directions(g: Gaussians, weights: ArrayLike, viewpoints: ArrayLike, tau: float = TAU) -> U8:
    """Gather direction sets from viewpoints: a face counts if any direction in it was seen.

    Join the sets of several calls with `|`.

    Args:
        g: The scene, N Gaussians.
        weights: (V, N) largest weight of each Gaussian from each viewpoint.
        viewpoints: (V, 3) positions, world frame.
        tau: Least weight of a visible Gaussian.

    Returns:
        (N, 10) uint8.

    Raises:
        ValueError: If shapes do not fit.

    References:
        SRBF-Gaussian, section 3.1.
    """
    points = _check.floats("viewpoints", viewpoints, ("V", 3), np.float64)
    seen = _check.floats("weights", weights, (len(points), len(g)))
    sets = np.zeros((len(g), NUM_FACES // 8), np.uint8)
    _kernels_directions.gather(g.means, seen, points, np.float32(tau), *face_planes(), sets)
    return sets


def directions_from_cameras(tracer: Tracer, cameras: Cameras, tau: float = TAU, *, progress: Progress = silent) -> U8:
    """Gather direction sets from the pixel rays of cameras.

    Args:
        tracer: The scene, N Gaussians.
        cameras: Any number of cameras; memory holds one at a time.
        tau: Least weight of a visible Gaussian.
        progress: Called with stage "cameras".

    Returns:
        (N, 10) uint8.
    """
    g = tracer.proxies.gaussians
    sets = np.zeros((len(g), NUM_FACES // 8), np.uint8)
    progress("cameras", 0, len(cameras))
    for c in range(len(cameras)):
        camera = cameras[c]
        sets |= seen_directions(g, visible_in(tracer, camera), camera.viewpoints, tau)
        progress("cameras", c + 1, len(cameras))
    return sets


def trace_directions(
    tracer: Tracer,
    navigable: NavigableSpace,
    *,
    ids: ArrayLike | None = None,
    rays_per_face: int = 1,
    tau: float = TAU,
    progress: Progress = silent,
) -> U8:
    """Trace direction sets outward: a face counts if an eye in navigable space would see the Gaussian along it.

    On each ray from the center of the Gaussian the eye is put into the first navigable voxel that the ray meets; more
    distant eyes on the same ray see no more. No cameras are needed.

    Args:
        tracer: The scene, N Gaussians.
        navigable: Allowed viewpoints.
        ids: (M,) Gaussians to trace; None means all N.
        rays_per_face: 1, 4, 16 or 64 rays spread over each face; one that sees the Gaussian is enough.
        tau: Least weight of a visible Gaussian.
        progress: Called with stage "directions".

    Returns:
        (M, 10) uint8.

    Raises:
        ValueError: If an id is out of range.
    """
    chosen = tracer.check_ids(ids)
    sets = np.zeros((len(chosen), NUM_FACES // 8), np.uint8)
    progress("directions", 0, len(chosen))
    for start in range(0, len(chosen), _CHUNK):
        part = slice(start, min(start + _CHUNK, len(chosen)))
        _trace(tracer, navigable, chosen[part], face_directions(rays_per_face), tau, sets[part])
        progress("directions", part.stop, len(chosen))
    return sets


def solid_angle_fractions(
    tracer: Tracer,
    navigable: NavigableSpace,
    *,
    ids: ArrayLike | None = None,
    rays_per_face: int = 16,
    tau: float = TAU,
    progress: Progress = silent,
) -> NDArray[np.float32]:
    """Return the share of directions, by solid angle, from which an eye in navigable space would see each Gaussian.

    Direction sets count a face as soon as any direction in it is seen, so finer sampling only ever adds faces, and adds
    many. This measure weights each ray by its solid angle, so it converges.

    Args:
        tracer: The scene, N Gaussians.
        navigable: Allowed viewpoints.
        ids: (M,) Gaussians to trace; None means all N.
        rays_per_face: 1, 4, 16 or 64 rays spread over each of the 80 faces.
        tau: Least weight of a visible Gaussian.
        progress: Called with stage "directions".

    Returns:
        (M,) float32 in [0, 1].

    Raises:
        ValueError: If an id is out of range.
    """
    chosen = tracer.check_ids(ids)
    rays = face_directions(rays_per_face)
    areas = face_shares(rays_per_face)
    fractions = np.zeros(len(chosen))
    progress("directions", 0, rays_per_face)
    for k in range(rays_per_face):
        sets = np.zeros((len(chosen), NUM_FACES // 8), np.uint8)
        _trace(tracer, navigable, chosen, np.ascontiguousarray(rays[:, k : k + 1]), tau, sets)
        fractions += np.unpackbits(sets, axis=1, bitorder="little") @ areas[:, k]
        progress("directions", k + 1, rays_per_face)
    return fractions.astype(np.float32)


def seen_from_space(
    tracer: Tracer,
    navigable: NavigableSpace,
    *,
    ids: ArrayLike | None = None,
    rays_per_face: int = 1,
    tau: float = TAU,
    progress: Progress = silent,
) -> NDArray[np.bool_]:
    """Return whether an eye in navigable space sees each Gaussian, on rays outward from its center.

    The same as `trace_directions(...).any(axis=1)`, but faster: it stops at the first ray that sees the Gaussian.

    Args:
        tracer: The scene, N Gaussians.
        navigable: Allowed viewpoints.
        ids: (M,) Gaussians to test; None means all N.
        rays_per_face: 1, 4, 16 or 64 rays spread over each of the 80 faces.
        tau: Least weight of a visible Gaussian.
        progress: Called with stage "directions".

    Returns:
        (M,) bool.

    Raises:
        ValueError: If an id is out of range.
    """
    chosen = tracer.check_ids(ids)
    hierarchy = tracer.hierarchy
    rays = face_directions(rays_per_face).reshape(-1, 3)
    rays = np.ascontiguousarray(rays[np.random.default_rng(0).permutation(len(rays))])  # neighbors fail together
    grid = (*_check.read_only(navigable.free, np.asarray(navigable.origin, np.float64)), float(navigable.voxel_size))
    seen = np.zeros(len(chosen), bool)
    progress("directions", 0, len(chosen))
    for start in range(0, len(chosen), _CHUNK):
        part = slice(start, min(start + _CHUNK, len(chosen)))
        targets = hierarchy.positions[chosen[part]]
        _kernels_directions.see_from_space(
            *hierarchy.arrays, targets, rays, *grid, tracer.limits, float(tau), seen[part]
        )
        progress("directions", part.stop, len(chosen))
    return seen


def _trace(tracer: Tracer, navigable: NavigableSpace, ids: NDArray[np.int64], rays: F64, tau: float, sets: U8) -> None:
    """Trace the Gaussians along the rays, and set the bits of `sets`."""
    hierarchy = tracer.hierarchy
    grid = (*_check.read_only(navigable.free, np.asarray(navigable.origin, np.float64)), float(navigable.voxel_size))
    targets = hierarchy.positions[ids]
    _kernels_directions.trace_outward(*hierarchy.arrays, targets, rays, *grid, tracer.limits, float(tau), sets)


def direction_fractions(sets: ArrayLike) -> NDArray[np.float32]:
    """Return the share of the 80 directions from which each Gaussian is visible.

    Args:
        sets: (N, 10) uint8 direction sets.

    Returns:
        (N,) seen faces over 80, in [0, 1]; 0 for a Gaussian that is never seen.

    Raises:
        ValueError: If the last axis is not 10 bytes.

    References:
        SRBF-Gaussian, section 3.1 and figure 3.
    """
    return np.asarray(_counts(_sets("sets", sets)) / NUM_FACES, np.float32)


def direction_cdf(fractions: ArrayLike) -> F64:
    """Return the cumulative distribution of direction fractions.

    Args:
        fractions: (N,) fractions, as `direction_fractions` returns them.

    Returns:
        (81,) float64; entry k is the share of Gaussians seen from at most k faces. The share seen from *less than*
        k faces, as the paper counts, is entry k - 1.

    Raises:
        ValueError: If `fractions` is empty or out of [0, 1].

    References:
        SRBF-Gaussian, figure 3.
    """
    values = _check.floats("fractions", fractions, ("N",))
    if len(values) == 0:
        raise ValueError("fractions: expected at least one, got none")
    _check.in_range("fractions", values, 0.0, 1.0)
    counts = np.bincount(np.rint(values * NUM_FACES).astype(np.int64), minlength=NUM_FACES + 1)
    return np.asarray(np.cumsum(counts) / len(values))


def jaccard(left: ArrayLike, right: ArrayLike) -> F64:
    """Return the agreement of two direction sets of each Gaussian: faces in both over faces in either.

    Args:
        left: (N, 10) uint8.
        right: (N, 10) uint8.

    Returns:
        (N,) float64 in [0, 1]; 1 if both are empty.
    """
    a = _sets("left", left)
    b = _sets("right", right)
    _check.same_length(left=a, right=b)
    either = _counts(a | b)
    return np.where(either == 0, 1.0, _counts(a & b) / np.maximum(either, 1))


def _sets(name: str, value: ArrayLike) -> U8:
    """Return checked direction sets (N, 10)."""
    array = np.asarray(value)
    if array.ndim != 2 or array.shape[1] != NUM_FACES // 8 or array.dtype != np.uint8:
        raise ValueError(f"{name}: expected (N, 10) uint8, got {array.shape} {array.dtype}")
    return array


def _counts(sets: U8) -> NDArray[np.int64]:
    """Return the number of faces in each set."""
    return np.asarray(np.unpackbits(sets, axis=1).sum(axis=1, dtype=np.int64))


def face_planes() -> tuple[F64, F64]:
    """Return centers (20, 3) of the icosahedron's faces, and (20, 3, 3) planes that cut off their three corners."""
    vertices, faces = icosphere(0)
    centers = vertices[faces].sum(axis=1)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    planes = np.stack([np.cross(a + b, c + a), np.cross(b + c, a + b), np.cross(c + a, b + c)], axis=1)
    return np.ascontiguousarray(centers), np.ascontiguousarray(planes)
