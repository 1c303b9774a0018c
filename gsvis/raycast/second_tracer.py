"""Trace rays by two tracers and compare: our hierarchy, and Open3D's Embree on the proxy meshes. Scene frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis.errors import BackendError
from gsvis.raycast.tracer import Contributions, Tracer
from gsvis.scene.repeats import first_equal

__all__ = ["CrossCheck", "compare", "cross_check", "describe_check"]

_SAME = 1e-5  # largest difference of a weight between two tracers that agree


@dataclass(frozen=True)
class CrossCheck:
    """Rays traced by two tracers.

    Attributes:
        rays: Number of rays compared.
        agreeing: Rays on which both tracers list the same Gaussians in the same order, with equal weights. Exact
            repeats count as one.
        largest_difference: Largest difference of the weight of one Gaussian on one ray.
    """

    rays: int
    agreeing: int
    largest_difference: float


def cross_check(tracer: Tracer, rays_o: ArrayLike, rays_d: ArrayLike) -> CrossCheck | None:
    """Trace rays a second time, through the proxy meshes by Open3D's Embree, and compare.

    Only the search for Gaussians is independent; the same code computes their alphas.

    Args:
        tracer: The scene.
        rays_o: (R, 3) origins.
        rays_d: (R, 3) directions.

    Returns:
        How many rays agree; None if the engine of the tracer is not Open3D, or Open3D cannot be loaded.
    """
    if tracer.engine != "open3d":
        return None
    try:
        twin = tracer.contributions_by_parts(rays_o, rays_d)
    except BackendError:
        return None
    ours = tracer.contributions(rays_o, rays_d, search="hierarchy")
    return compare(ours, twin, first_equal(tracer.proxies.gaussians))


def compare(one: Contributions, other: Contributions, ties: NDArray[np.int64]) -> CrossCheck:
    """Compare what two tracers found on the same R rays of a scene of N Gaussians.

    Exact repeats are a tie: their weights on a ray are summed, and their order does not count.

    Args:
        one: Contributions by one tracer.
        other: Contributions by the other tracer.
        ties: (N,) the first Gaussian that equals each; `gsvis.scene.repeats.first_equal` finds it.
    """
    gaussians = len(ties)
    keys = [each.ray_ids * gaussians + ties[each.gaussian_ids] for each in (one, other)]
    together, place = np.unique(np.concatenate(keys), return_inverse=True)
    values = np.zeros((2, len(together)))
    np.add.at(values[0], place[: len(keys[0])], one.weights)
    np.add.at(values[1], place[len(keys[0]) :], other.weights)
    apart = np.abs(values[0] - values[1])
    differs = np.zeros(len(one), bool)
    differs[together[apart > _SAME] // gaussians] = True
    # A ray may stop inside a tie, so each tie counts once in the order along a ray.
    runs = [key[np.flatnonzero(np.diff(key, prepend=-1))] for key in keys]
    counts = [np.bincount(run // gaussians, minlength=len(one)) for run in runs]
    differs |= counts[0] != counts[1]
    # Where all counts are equal up to a ray, the rows line up; compare the order of those rays alone.
    same = ~differs
    rows = [np.repeat(same, count) for count in counts]
    unequal = runs[0][rows[0]] != runs[1][rows[1]]
    differs[runs[0][rows[0]][unequal] // gaussians] = True
    return CrossCheck(len(one), int(np.count_nonzero(~differs)), float(apart.max(initial=0.0)))


def describe_check(check: CrossCheck | None) -> str:
    """Return in words on how many rays both tracers agree; `check` is what `cross_check` returned."""
    if check is None:
        return "not compared: Open3D is not installed, or cannot be loaded"
    if check.agreeing == check.rays:
        return f"on all of {check.rays:,} rays, ids and weights"
    return f"on {check.agreeing:,} of {check.rays:,} rays; weights differ by up to {check.largest_difference:.2g}"
