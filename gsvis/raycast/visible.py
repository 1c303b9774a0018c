"""Find the Gaussians that an eye sees: the largest weight of each over rays from viewpoints or cameras.

There are two samplings. Pixel rays give what an image of that size shows; they miss some Gaussians smaller
than a pixel. Gaussian rays run from the eye to each Gaussian and need no resolution. World frame, scene units.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import get_num_threads
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.progress import Progress, silent
from gsvis.raycast._kernels import trace as _kernels
from gsvis.raycast.tracer import TAU, Tracer
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import rotations_from_quats

__all__ = ["GaussianRays", "visible_from", "visible_in"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


@dataclass(frozen=True)
class GaussianRays:
    """How to cast Gaussian rays.

    Attributes:
        ring: Number of rays to points on the one-sigma ring seen from the eye, besides the one to the center. 0
            finds a Gaussian only by its center; 4 or more also finds those partly visible past an edge.
        floor: Weights below it are returned as 0, so that hidden Gaussians end early.
    """

    ring: int = 0
    floor: float = TAU / 4.0

    def __post_init__(self) -> None:
        _check.positive_int("ring", self.ring, at_least=0)
        if not 0.0 <= self.floor <= 1.0:
            raise ValueError(f"floor: expected a weight in [0, 1], got {self.floor!r}")


def visible_in(tracer: Tracer, cameras: Cameras, *, progress: Progress = silent) -> F32:
    """Return the largest weight of each Gaussian over the pixel rays of each camera.

    Args:
        tracer: The scene.
        cameras: C cameras; one ray through each pixel center.
        progress: Called with stage "cameras".

    Returns:
        (C, N) float32; a Gaussian is visible in camera c if the entry is at least tau.
    """
    weights = np.zeros((len(cameras), len(tracer.proxies.gaussians)), np.float32)
    progress("cameras", 0, len(cameras))
    for c in range(len(cameras)):
        weights[c] = _largest(tracer, *cameras[c].rays())
        progress("cameras", c + 1, len(cameras))
    return weights


def visible_from(
    tracer: Tracer,
    viewpoints: ArrayLike,
    *,
    sampling: str = "pixels",
    size: int = 128,
    rays: GaussianRays | None = None,
    ids: ArrayLike | None = None,
    progress: Progress = silent,
) -> F32:
    """Return the largest weight of each Gaussian from each viewpoint, in all directions.

    Args:
        tracer: The scene.
        viewpoints: (V, 3) positions, world frame.
        sampling: "pixels" casts the rays of a cubemap; "gaussians" casts rays to every Gaussian.
        size: Pixels along a side of the cubemap faces (sampling "pixels").
        rays: How to cast Gaussian rays (sampling "gaussians"); None means `GaussianRays()`.
        ids: (M,) Gaussians to test; None means all N. With Gaussian rays the cost grows with their number.
        progress: Called with stage "viewpoints".

    Returns:
        (V, N) float32, or (V, M) with ids; a Gaussian is visible from viewpoint v if the entry is at least tau.

    Raises:
        ValueError: If an argument is out of range.
    """
    _check.one_of("sampling", sampling, ("pixels", "gaussians"))
    points = _check.floats("viewpoints", viewpoints, ("V", 3), np.float64)
    chosen = tracer.check_ids(ids)
    weights = np.zeros((len(points), len(chosen)), np.float32)
    progress("viewpoints", 0, len(points))
    for v, point in enumerate(points):
        if sampling == "pixels":
            weights[v] = _largest(tracer, *Cameras.cubemap(point[None], size).rays())[chosen]
        else:
            weights[v] = _to_gaussians(tracer, point, rays or GaussianRays(), chosen)
        progress("viewpoints", v + 1, len(points))
    return weights


def _largest(tracer: Tracer, rays_o: F64, rays_d: F64) -> F32:
    """Return the largest weight of each Gaussian over the rays."""
    if tracer.search == "faces":
        found = np.zeros(len(tracer.proxies.gaussians), np.float32)
        for _, part in tracer.iter_contributions(rays_o, rays_d):
            np.maximum.at(found, part.gaussian_ids, part.weights)
        return found
    hierarchy = tracer.hierarchy
    rows = np.zeros((get_num_threads(), len(hierarchy.ids)), np.float32)
    _kernels.largest_weights(*hierarchy.arrays, rays_o, rays_d, tracer.limits, rows)
    weights = np.zeros(len(hierarchy.positions), np.float32)
    weights[hierarchy.ids] = rows.max(axis=0) if len(rows) else 0.0
    return weights


def _to_gaussians(tracer: Tracer, eye: F64, rays: GaussianRays, ids: NDArray[np.int64]) -> F32:
    """Return weights (M,) from one eye along rays to the center and the ring of the Gaussians ids (M,)."""
    hierarchy = tracer.hierarchy
    g = tracer.proxies.gaussians
    there = np.flatnonzero(hierarchy.positions[ids] >= 0)  # the others are too faint to be visible
    targets = np.sort(hierarchy.positions[ids[there]])  # neighbors in sequence: their paths share memory
    owners = hierarchy.ids[targets]
    means = g.means[owners].astype(np.float64)
    best = np.zeros(len(targets))
    out = np.empty(len(targets))
    for offset in _offsets(means, g.quats[owners], g.scales[owners], eye, rays.ring):
        toward = means + offset - eye
        length = np.linalg.norm(toward, axis=1)
        toward[length == 0.0] = (1.0, 0.0, 0.0)  # the eye is at the center: any direction will do
        toward /= np.where(length == 0.0, 1.0, length)[:, None]
        rays_o = np.tile(eye, (len(toward), 1))
        _kernels.weights_of(*hierarchy.arrays, rays_o, toward, targets, tracer.limits, rays.floor, out)
        np.maximum(best, out, out=best)
    everything = np.zeros(len(g), np.float32)
    everything[owners] = best
    return everything[ids]


def _offsets(means: F64, quats: F32, scales: F32, eye: F64, ring: int) -> list[F64]:
    """Return offsets (M, 3) from the centers to the ray targets."""
    offsets = [np.zeros((len(means), 3))]
    if ring == 0 or len(means) == 0:
        return offsets
    rotations = rotations_from_quats(quats)
    axes = rotations * scales.astype(np.float64)[:, None, :]  # world from whitened
    view = np.einsum("nji,nj->ni", rotations, means - eye) / scales
    norm = np.linalg.norm(view, axis=1, keepdims=True)
    view = np.where(norm > 0.0, view / np.where(norm > 0.0, norm, 1.0), (1.0, 0.0, 0.0))
    u = np.cross(view, np.eye(3)[np.abs(view).argmin(axis=1)])
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(view, u)
    for angle in 2.0 * np.pi * np.arange(ring) / ring:
        offsets.append(np.einsum("nij,nj->ni", axes, np.cos(angle) * u + np.sin(angle) * v))
    return offsets
