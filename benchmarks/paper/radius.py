"""Calibrate the radius of hidden point removal against a measure of visibility.

Too small a radius loses visible points, too large a one shows hidden ones: the number of visible points grows with the
radius over its whole range. World frame, scene units.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.hpr.operator import hidden_point_removal
from gsvis.raycast import TAU

__all__ = ["Calibration", "Trial", "calibrate_radius"]

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

_GRID = 9


@dataclass(frozen=True)
class Trial:
    """A tested radius and its quality.

    Attributes:
        radius: Radius of the flip, scene units.
        recall: Share of the summed weights that belongs to visible points.
        precision: Share of the visible points whose weight is at least tau.
        count: Number of visible points.
    """

    radius: float
    recall: float
    precision: float
    count: int

    @property
    def f1(self) -> float:
        """Harmonic mean of recall and precision; 0 where both are 0."""
        total = self.recall + self.precision
        return 2.0 * self.recall * self.precision / total if total > 0.0 else 0.0


@dataclass(frozen=True)
class Calibration(Trial):
    """The chosen radius and its quality.

    Attributes:
        radius: Radius of the flip, scene units.
        recall: Share of the summed weights that belongs to visible points.
        precision: Share of the visible points whose weight is at least tau.
        count: Number of visible points.
        tried: All tested radii, ascending.
    """

    tried: tuple[Trial, ...]


def calibrate_radius(
    points: ArrayLike,
    viewpoint: ArrayLike,
    weights: ArrayLike | None = None,
    *,
    recall: float | None = None,
    tau: float = TAU,
    most: float = 1e5,
    steps: int = 8,
) -> Calibration:
    """Return the radius at which hidden point removal agrees best with a given visibility.

    With `recall`, it is the smallest radius found that keeps that share of the weights. This radius has the best
    precision: the visible set grows with the radius (a visible point is very rarely lost again). Without `recall`, it
    has the largest F1 of recall and precision.

    Without weights, the criterion of Katz et al. applies: two eyes on opposite sides of an object never see the same
    point, so the best radius is the one at which the most points are seen by exactly one eye. It holds only for eyes
    outside the object. `recall` is then the share of all points seen by exactly one eye, and `precision` the share of
    points seen from here that the other eye does not see.

    Args:
        points: (N, 3) positions, world frame.
        viewpoint: (3,) the eye.
        weights: (N,) true visibility of each point, such as from `gsvis.raycast.visible_from`; None if unknown.
        recall: Required share of the summed weights, in (0, 1]; needs weights.
        tau: Least weight of a visible point, in (0, 1].
        most: Largest radius to test, over the distance of the farthest point, > 1. The smallest is that distance.
        steps: Number of radii that refine the choice, after nine evenly spaced on a logarithmic scale.

    Returns:
        The radius, its quality, and all tested radii. If no radius reaches the required recall, the one with the
        highest recall.

    Raises:
        ValueError: If an argument is out of range, no weight is above 0, or no weights are given for an eye inside
            the box of the points.

    References:
        Katz, Tal, Basri, "Direct visibility of point sets", SIGGRAPH 2007, section 4 (the two viewpoints).
    """
    cloud = _check.floats("points", points, ("N", 3), np.float64)
    eye = _check.floats("viewpoint", viewpoint, (3,), np.float64)
    if len(cloud) == 0:
        raise ValueError("points: expected at least one point, got none")
    low = float(np.linalg.norm(cloud - eye, axis=1).max()) * (1.0 + 1e-9)
    if low == 0.0:
        raise ValueError("points: expected a point away from the viewpoint, got none")
    if weights is not None:
        judge = _by_weights(cloud, eye, _check_weights(weights, len(cloud)), tau)
    else:
        judge, low = _by_two_eyes(cloud, eye, recall)
    return search_radius(judge, low, low * _more_than_one(most), recall=recall, steps=steps)


def search_radius(
    judge: Callable[[float], Trial], low: float, high: float, *, recall: float | None = None, steps: int = 8
) -> Calibration:
    """Return the best radius in [low, high] by `judge`; geometric grid first, then refined.

    Args:
        judge: Tests one radius.
        low: Smallest radius.
        high: Largest radius.
        recall: Required share of the summed weights, in (0, 1], or None.
        steps: Number of radii to test after the grid.

    Raises:
        ValueError: If `recall` or `steps` is out of range.
    """
    if recall is not None and not 0.0 < recall <= 1.0:
        raise ValueError(f"recall: expected a share in (0, 1], got {recall!r}")
    _check.positive_int("steps", steps, at_least=0)
    tried: list[Trial] = []

    def key(trial: Trial) -> tuple[float, ...]:
        if recall is None:
            return trial.f1, -trial.radius
        enough = trial.recall >= recall
        return (1.0, trial.precision, -trial.radius) if enough else (0.0, trial.recall, -trial.radius)

    for radius in np.geomspace(low, high, _GRID):
        tried.append(judge(float(radius)))
        if recall is not None and tried[-1].recall >= recall:
            break  # sets grow: later ones are larger and less precise
    for _ in range(steps):
        tried.sort(key=lambda trial: trial.radius)
        best = max(range(len(tried)), key=lambda i: key(tried[i]))
        ends = [i for i in (best - 1, best + 1) if 0 <= i < len(tried)]
        if recall is not None:
            ends = [i for i in ends if i < best] if tried[best].recall >= recall else [i for i in ends if i > best]
        gaps = [abs(np.log(tried[i].radius / tried[best].radius)) for i in ends]
        if not gaps or max(gaps) < 1e-3:
            break
        tried.append(judge(float(np.sqrt(tried[best].radius * tried[ends[int(np.argmax(gaps))]].radius))))
    tried.sort(key=lambda trial: trial.radius)
    chosen = max(tried, key=key)
    return Calibration(chosen.radius, chosen.recall, chosen.precision, chosen.count, tuple(tried))


def measure_points(radius: float, ids: I64, weights: F64, tau: float) -> Trial:
    """Return the quality of a set of points ids (K,) by weights (N,) whose sum is above 0."""
    held = weights[ids]
    precision = float(np.count_nonzero(held >= tau)) / len(ids) if len(ids) else 0.0
    return Trial(float(radius), float(held.sum() / weights.sum()), precision, len(ids))


def _by_weights(cloud: F64, eye: F64, weights: F64, tau: float) -> Callable[[float], Trial]:
    if not 0.0 < tau <= 1.0:
        raise ValueError(f"tau: expected a weight in (0, 1], got {tau!r}")
    return lambda radius: measure_points(radius, hidden_point_removal(cloud, eye, radius), weights, tau)


def _by_two_eyes(cloud: F64, eye: F64, recall: float | None) -> tuple[Callable[[float], Trial], float]:
    """Return the judge for points without weights, and the smallest radius valid for both eyes."""
    if recall is not None:
        raise ValueError(f"recall: expected weights to measure it by, got {recall!r} without weights; give weights")
    corner = cloud.min(axis=0)
    opposite_corner = cloud.max(axis=0)
    if np.all((eye >= corner) & (eye <= opposite_corner)):
        raise ValueError(
            "viewpoint: expected an eye outside the box of the points, got one inside, which no second eye is opposite "
            "to; give weights, for instance of gsvis.raycast.visible_from"
        )
    other = corner + opposite_corner - eye
    low = max(float(np.linalg.norm(cloud - place, axis=1).max()) for place in (eye, other)) * (1.0 + 1e-9)

    def judge(radius: float) -> Trial:
        here = hidden_point_removal(cloud, eye, radius)
        there = hidden_point_removal(cloud, other, radius)
        both = len(np.intersect1d(here, there, assume_unique=True))
        once = len(here) + len(there) - 2 * both  # seen by exactly one: the measure to maximize
        return _Disjoint(radius, once / len(cloud), 1.0 - both / max(len(here), 1), len(here))

    return judge, low


@dataclass(frozen=True)
class _Disjoint(Trial):
    """A trial without weights: `recall` is the share of the points seen by exactly one of two opposite eyes."""

    @property
    def f1(self) -> float:
        return self.recall


def _check_weights(weights: ArrayLike, count: int) -> F64:
    array: F64 = _check.floats("weights", weights, ("N",), np.float64)
    if len(array) != count:
        raise ValueError(f"weights: expected {count}, one for each point, got {len(array)}")
    _check.in_range("weights", array, 0.0, np.inf)
    if not array.sum() > 0.0:
        raise ValueError("weights: expected at least one above 0, got none; the eye sees no point")
    return array


def _more_than_one(most: float) -> float:
    if not (np.isfinite(most) and most > 1.0):
        raise ValueError(f"most: expected a finite factor > 1, got {most!r}")
    return float(most)
