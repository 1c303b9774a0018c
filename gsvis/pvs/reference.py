"""Reference implementations of this room, short and slow: the oracle of the tests."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import NDArray

from gsvis.pvs.bound import STAKES
from gsvis.raycast.reference import brute_force_contributions
from gsvis.scene.gaussians import Gaussians

__all__ = ["missed_light_reference", "upper_bound_reference"]


def upper_bound_reference(part: Sequence[float], whole: Sequence[float], error: float, steps: int = 100_000) -> float:
    """Return the least of `steps` equal shares at which some capital has grown to 1 / error; 1 if there is none.

    Args:
        part: Samples in [0, whole].
        whole: Samples in [0, 1].
        error: Probability in (0, 1) that the bound is too low.
        steps: Number of shares that are tried, one after the other.
    """
    for step in range(steps):
        ratio = step / steps
        capital = 0.0
        for stake, share in STAKES:
            money = share
            for a, b in zip(part, whole, strict=True):
                money *= 1.0 - stake * (a - ratio * b) / (1.0 - ratio)
            capital += money
        if capital >= 1.0 / error:
            return ratio
    return 1.0


def missed_light_reference(
    g: Gaussians, ids: Collection[int], rays_o: NDArray[np.float64], rays_d: NDArray[np.float64]
) -> list[tuple[float, float]]:
    """Return for each ray the weight of the Gaussians outside a set, and the weight of all.

    Args:
        g: The scene.
        ids: Gaussians of the set.
        rays_o: (R, 3) origins.
        rays_d: (R, 3) directions.
    """
    hits = brute_force_contributions(g, rays_o, rays_d)
    sums = []
    for ray in range(len(hits)):
        row = range(hits.ray_offsets[ray], hits.ray_offsets[ray + 1])
        weights = [(int(hits.gaussian_ids[k]), float(hits.weights[k])) for k in row]
        sums.append((sum(w for k, w in weights if k not in ids), sum(w for _, w in weights)))
    return sums
