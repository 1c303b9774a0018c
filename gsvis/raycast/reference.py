"""Trace by brute force: every Gaussian against every ray, from the definitions. The oracle of this room.

Slow and short on purpose: float64 NumPy, one ray at a time, no hierarchy, no proxies. World frame, scene units.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis.raycast.proxies import MIN_ALPHA
from gsvis.raycast.tracer import MAX_ALPHA, MIN_TRANSMITTANCE, Contributions, _rays
from gsvis.scene.gaussians import Gaussians

__all__ = ["brute_force_contributions", "brute_force_near"]


def brute_force_contributions(
    g: Gaussians, rays_o: ArrayLike, rays_d: ArrayLike, *, min_alpha: float = MIN_ALPHA
) -> Contributions:
    """Return what `Tracer.contributions` must return, from the definitions alone.

    Args:
        g: The scene.
        rays_o: (R, 3) origins, world frame.
        rays_d: (R, 3) directions, any non-zero length.
        min_alpha: Alpha below this counts as 0.
    """
    origins, directions = _rays(rays_o, rays_d)
    whitening = np.swapaxes(g.rotations(), 1, 2) / g.scales.astype(np.float64)[:, :, None]
    opacities = g.opacities.astype(np.float64)
    content = np.concatenate([g.means, g.scales, g.quats, g.opacities[:, None], g.sh0[:, 0]], axis=1)
    rank = np.empty(len(g), np.int64)
    rank[np.lexsort(content.T[::-1])] = np.arange(len(g))
    parts = []
    for o, d in zip(origins, directions, strict=True):
        p = np.einsum("nij,nj->ni", whitening, o - g.means.astype(np.float64))
        q = whitening @ d
        length = np.linalg.norm(q, axis=1)
        unit = q / length[:, None]
        depth = -np.einsum("ni,ni->n", p, unit) / length
        across = np.linalg.norm(np.cross(p, unit), axis=1)
        distance = np.where(depth > 0.0, across, np.linalg.norm(p, axis=1))
        alpha = opacities * np.exp(-0.5 * distance**2)
        hit = np.flatnonzero(alpha >= min_alpha)
        hit = hit[np.lexsort((rank[hit], depth[hit].astype(np.float32)))]
        alpha = np.minimum(alpha[hit], MAX_ALPHA)
        transmittance = np.concatenate([[1.0], np.cumprod(1.0 - alpha)])[:-1]
        lit = transmittance >= MIN_TRANSMITTANCE
        weight = (alpha * transmittance)[lit].astype(np.float32)
        fields = (hit[lit], alpha[lit].astype(np.float32), weight, np.maximum(depth[hit][lit], 0.0).astype(np.float32))
        parts.append(Contributions(np.array([0, lit.sum()]), *fields))
    return Contributions.concatenate(parts)


def brute_force_near(
    centers: NDArray[np.float64], reaches: NDArray[np.float64], rays_o: ArrayLike, rays_d: ArrayLike, rounding: float
) -> NDArray[np.bool_]:
    """Return what the kernel `mark_near` must mark: balls (N,) that some ray comes as near as their reach.

    Args:
        centers: (N, 3) centers, world frame.
        reaches: (N,) radii.
        rays_o: (R, 3) origins.
        rays_d: (R, 3) directions, any non-zero length.
        rounding: Added to the radii, times the distance from the origin.
    """
    found = np.zeros(len(centers), bool)
    for o, d in zip(*_rays(rays_o, rays_d), strict=True):
        away = np.linalg.norm(centers - o, axis=1)
        nearest = o + np.maximum((centers - o) @ d, 0.0)[:, None] * d
        found |= np.linalg.norm(centers - nearest, axis=1) <= reaches + rounding * away
    return found
