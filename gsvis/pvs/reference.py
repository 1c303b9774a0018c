"""Reference implementations of this room, short and slow, to which the tests compare."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from fractions import Fraction
from math import floor

import numpy as np
from numpy.typing import NDArray

from gsvis.pvs.bound import STAKES
from gsvis.raycast.reference import brute_force_contributions
from gsvis.scene.gaussians import Gaussians

__all__ = ["marked_reference", "missed_light_reference", "split_classes_reference", "upper_bound_reference"]


def upper_bound_reference(part: Sequence[float], whole: Sequence[float], error: float, steps: int = 100_000) -> float:
    """Return the least of `steps` equal shares at which a capital reaches 1 / error; 1 if there is none.

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


def marked_reference(
    boxes: NDArray[np.float64], low: NDArray[np.float64], high: NDArray[np.float64], size: int
) -> NDArray[np.bool_] | None:
    """Return (6, S, S) the pixels in which an eye may see a box, one box after the other; None if it may be inside one.

    Args:
        boxes: (N, 2, 3) lowest and highest corner of each box.
        low: (3,) lowest corner of the eyes.
        high: (3,) highest corner.
        size: S, pixels along a side of the faces.
    """
    marked = np.zeros((6, size, size), bool)
    edges = np.linspace(-1.0, 1.0, size + 1)
    for near, far in zip(boxes[:, 0] - high, boxes[:, 1] - low, strict=True):
        if (near <= 0.0).all() and (far >= 0.0).all():
            return None
        for face in range(6):
            w = face // 2
            u, v = (k for k in range(3) if k != w)
            z = np.maximum([near[w], far[w]] if face % 2 == 0 else [-far[w], -near[w]], 1e-12)
            if z[1] <= 1e-12:
                continue
            spans = []
            for axis in (u, v):
                tangents = np.divide.outer([near[axis], far[axis]], z)
                spans.append((edges[1:] > tangents.min()) & (edges[:-1] <= tangents.max()))
            marked[face] |= spans[1][:, None] & spans[0][None, :]
    return marked


def split_classes_reference(
    cells: Sequence[dict[int, int]], n: int, run: int, classes: int, rounds: int = 2
) -> tuple[list[int], list[list[int]]]:
    """Return the class of each of N Gaussians, and for each cell the shift of each run of them.

    Args:
        cells: For each cell the class of each Gaussian that it sees.
        n: N.
        run: Gaussians in a run.
        classes: K, number of classes.
        rounds: How often classes and shifts are found.
    """
    shifts = [[0] * -(-n // run) for _ in cells]
    common = [0] * n
    for _ in range(rounds):
        for g in range(n):
            without = [seen[g] - shifts[cell][g // run] for cell, seen in enumerate(cells) if g in seen]
            common[g] = min(max(_rounded_mean(without), 0), classes - 1)
        for cell, seen in enumerate(cells):
            for r in range(len(shifts[cell])):
                beyond = [seen[g] - common[g] for g in seen if g // run == r]
                shifts[cell][r] = _rounded_mean(beyond)
    return common, shifts


def _rounded_mean(values: Sequence[int]) -> int:
    """Return the mean of whole numbers, rounded, halves up; 0 without any."""
    return floor(Fraction(sum(values), len(values)) + Fraction(1, 2)) if values else 0
