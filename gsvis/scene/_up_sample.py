"""Sample the surface of a scene's core: places, normals, and the amount of surface that each point represents.

The search for the up axis works on this sample. It is independent of the order of the Gaussians, and follows rotation,
scale and translation of the scene. Lengths are in radii of the core, places are relative to its middle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis._sorting import stable_order
from gsvis.scene.drawn_by_content import draw_by_content
from gsvis.scene.gaussians import Gaussians

__all__ = ["FEWEST", "Sample", "sample_surface"]

F64 = NDArray[np.float64]

FEWEST = 64  # Gaussians below which nothing is estimated
_MOST = 20_000  # points of the sample
_SOME = 20_000  # points that the middle is found from
_REACH = 3.0  # radius of the core, in median distances from its middle
_NEIGHBORS = 16
_BLOCK = 4096
_WIDEST = 0.03  # standard deviation of a Gaussian at the most, radii: giants say little about a surface
_MIN_ALPHA = 1.0 / 255.0  # docs/conventions.md
_SH_C0 = 0.28209479177387814
_LUMA = np.array([0.299, 0.587, 0.114])


@dataclass(frozen=True, eq=False)
class Sample:
    """Points on the surface of the core of a scene.

    Args:
        places: (M, 3) relative to the middle, radii of the core.
        normals: (M, 3) unit normals of the surface around each point, of arbitrary sign.
        surface: (M,) share of the surface, weighted by its flatness; sums to 1.
        standing: (M,) share of the opacity, weighted by flatness; counts thin things that stand.
        detail: (M,) share of the opacity; sums to 1.
        mixed: (M,) mean of `detail` and of the share of the surface, flat or not; sums to 1.
        luminance: (M,) brightness of the base color.
    """

    places: F64
    normals: F64
    surface: F64
    standing: F64
    detail: F64
    mixed: F64
    luminance: F64


def sample_surface(g: Gaussians) -> Sample | None:
    """Return the sample of a scene; None if too few Gaussians can be seen, or all are in one place.

    Args:
        g: The scene.
    """
    order = _shuffle(g, np.flatnonzero(g.opacities >= _MIN_ALPHA))
    if len(order) < FEWEST:
        return None
    means = g.means[order].astype(np.float64)
    middle, radius = _find_core(means, g.opacities[order].astype(np.float64))
    picked = np.flatnonzero(np.linalg.norm(means - middle, axis=1) < radius)[:_MOST]
    if len(picked) < FEWEST or not radius > 0.0:
        return None
    places = (means[picked] - middle) / radius
    chosen = g[order[picked]]
    opacities = chosen.opacities.astype(np.float64)
    normals, flatness, spacing = _fit_surface(places, _covariances(chosen, radius), opacities)
    area = np.minimum(spacing, np.quantile(spacing, 0.95)) * np.minimum(1.0, 2.0 * opacities)
    surface = area * flatness**2
    detail = opacities / opacities.sum()
    if not surface.sum() > 0.0:
        return None
    base = np.clip(0.5 + _SH_C0 * chosen.sh0[:, 0].astype(np.float64), 0.0, 1.5)
    mixed = 0.5 * (detail + area / area.sum())
    return Sample(places, normals, surface / surface.sum(), detail * flatness**2, detail, mixed, base @ _LUMA)


def _shuffle(g: Gaussians, index: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return indices in a random order that depends only on the content of the Gaussians."""
    return index[stable_order(draw_by_content(g.without_harmonics()[index]))]


def _find_core(means: F64, weights: F64) -> tuple[F64, float]:
    """Return the middle of a scene and the radius around it that holds its core, unaffected by outliers."""
    some = means[:_SOME]
    share = weights[:_SOME]
    middle = np.median(some, axis=0)
    radius = np.inf
    for _ in range(3):
        near = np.linalg.norm(some - middle, axis=1) <= radius
        middle = _geometric_median(some[near], share[near])
        distances = np.linalg.norm(some - middle, axis=1)
        radius = _REACH * float(np.median(distances[distances <= radius]))
    return middle, radius


def _geometric_median(points: F64, weights: F64) -> F64:
    """Return the (3,) point with the least weighted sum of distances. Unlike a median, it follows rotations.

    References:
        Weiszfeld, "Sur le point pour lequel la somme des distances de n points donnes est minimum", 1937.
    """
    middle = np.median(points, axis=0)
    for _ in range(30):
        distances = np.linalg.norm(points - middle, axis=1)
        pull = weights / np.maximum(distances, max(1e-2 * float(np.median(distances)), 1e-300))
        middle = pull @ points / pull.sum()
    return np.asarray(middle)


def _covariances(g: Gaussians, radius: float) -> F64:
    """Return (M, 3, 3) covariances in squared radii, of Gaussians that are no wider than `_WIDEST`."""
    half = g.rotations() * np.minimum(g.scales.astype(np.float64) / radius, _WIDEST)[:, None, :]
    return np.asarray(half @ np.swapaxes(half, 1, 2))


def _fit_surface(places: F64, covars: F64, weights: F64) -> tuple[F64, F64, F64]:
    """Return normals (M, 3), flatness (M,) in [0, 1] and area (M,) of the surface that each point represents.

    The surface around a point is the mixture of the Gaussians next to it, including their shapes.
    """
    from scipy.spatial import cKDTree  # slow to import, and seldom needed

    tree = cKDTree(places)
    normals = np.empty((len(places), 3))
    flatness = np.empty(len(places))
    spacing = np.empty(len(places))
    for start in range(0, len(places), _BLOCK):
        part = slice(start, start + _BLOCK)
        distances, near = tree.query(places[part], k=_NEIGHBORS)
        share = weights[near] / weights[near].sum(axis=1, keepdims=True)
        around = places[near]
        offsets = around - (share[:, None] @ around)
        spread = np.swapaxes(offsets * share[:, :, None], 1, 2) @ offsets
        spread += (share[:, None] @ covars[near].reshape(len(near), _NEIGHBORS, 9)).reshape(-1, 3, 3)
        sizes, axes = np.linalg.eigh(spread)
        least = np.sqrt(np.maximum(sizes[:, 0], 0.0))
        mid = np.sqrt(np.maximum(sizes[:, 1], 1e-300))
        normals[part], flatness[part] = axes[:, :, 0], np.clip(1.0 - least / mid, 0.0, 1.0)
        spacing[part] = distances[:, -1] ** 2
    return normals, flatness, spacing
