"""Calibration: the radius that reaches a wanted recall or the best F1, the growth it rests on, and Katz's two eyes."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from paper.radius import calibrate_radius

from gsvis.hpr import hidden_point_removal


def sphere(n: int = 3000, seed: int = 0) -> np.ndarray:
    points = np.random.default_rng(seed).normal(size=(n, 3))
    return points / np.linalg.norm(points, axis=1)[:, None]


def facing(points: np.ndarray, eye: np.ndarray) -> np.ndarray:
    """(N,) 1 for the points of the unit sphere that an eye outside truly sees."""
    return (points @ eye > 1.0).astype(np.float64)


EYE = np.array([5.0, 1.0, 0.0])


def test_the_wanted_recall_is_reached_with_little_more() -> None:
    points = np.concatenate([sphere(), 0.9 * sphere(seed=1)])
    weights = np.concatenate([facing(points[:3000], EYE), np.zeros(3000)])
    for recall in (0.5, 0.9, 0.99):
        found = calibrate_radius(points, EYE, weights, recall=recall)
        assert found.recall >= recall
        seen = hidden_point_removal(points, EYE, found.radius)
        assert len(seen) == found.count
        assert found.recall == pytest.approx(weights[seen].sum() / weights.sum())
        assert found.precision == pytest.approx(weights[seen].mean())
        assert [trial.radius for trial in found.tried] == sorted(trial.radius for trial in found.tried)
        assert all(trial.recall < recall for trial in found.tried if trial.radius < found.radius)


def test_the_best_f1_is_at_least_that_of_a_plain_search() -> None:
    rng = np.random.default_rng(1)
    points = sphere() * rng.uniform(0.99, 1.0, (3000, 1))
    weights = facing(points / np.linalg.norm(points, axis=1)[:, None], EYE)
    found = calibrate_radius(points, EYE, weights)
    low = np.linalg.norm(points - EYE, axis=1).max() * (1 + 1e-9)
    for radius in np.geomspace(low, 1e5 * low, 12):
        seen = hidden_point_removal(points, EYE, radius)
        recall, precision = weights[seen].sum() / weights.sum(), weights[seen].mean()
        assert found.f1 >= 2 * recall * precision / (recall + precision) - 0.02
    assert found.f1 > 0.9


@given(seed=st.integers(0, 10**6))
def test_visible_sets_grow_with_the_radius(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(500, 3)) * rng.uniform(0.2, 1.0, 3)
    eye = rng.normal(size=3)
    low = np.linalg.norm(points - eye, axis=1).max() * (1 + 1e-9)
    sets = [set(hidden_point_removal(points, eye, low * 10**power)) for power in np.linspace(0, 5, 9)]
    lost = sum(len(a - b) for a, b in pairwise(sets))
    assert lost <= 0.01 * sum(map(len, sets))
    assert [len(s) for s in sets] == sorted(len(s) for s in sets)


def test_an_unreachable_recall_gives_the_most_there_is() -> None:
    points, weights = np.concatenate([sphere(300), 0.5 * sphere(300)]), np.ones(600)
    found = calibrate_radius(points, EYE, weights, recall=1.0, most=10.0)
    assert found.recall == max(trial.recall for trial in found.tried) < 1.0


def test_without_weights_two_opposite_eyes_decide() -> None:
    points = sphere()
    found = calibrate_radius(points, EYE)
    seen = hidden_point_removal(points, EYE, found.radius)
    truth = np.flatnonzero(facing(points, EYE))
    both = len(np.intersect1d(seen, truth))
    assert both > 0.95 * len(truth)
    assert both > 0.9 * len(seen)


def test_the_same_question_has_the_same_answer() -> None:
    points = sphere(500)
    assert calibrate_radius(points, EYE, facing(points, EYE)) == calibrate_radius(points, EYE, facing(points, EYE))


@pytest.mark.parametrize(
    ("words", "options"),
    [
        ("weights: expected 100, one for each point, got 3", {"weights": np.ones(3)}),
        ("weights: expected at least one above 0", {"weights": np.zeros(100)}),
        (r"weights: expected values in \[0, inf\), got -1", {"weights": -np.ones(100)}),
        (r"recall: expected a share in \(0, 1\]", {"weights": np.ones(100), "recall": 1.5}),
        ("recall: expected weights to measure it by", {"recall": 0.9}),
        ("tau: expected a weight", {"weights": np.ones(100), "tau": 0.0}),
        ("most: expected a finite factor > 1", {"weights": np.ones(100), "most": 1.0}),
        ("steps: expected an integer", {"weights": np.ones(100), "steps": -1}),
        ("viewpoint: expected an eye outside the box", {"viewpoint": np.zeros(3)}),
        ("points: expected at least one point", {"points": np.zeros((0, 3))}),
        ("points: expected a point away from the viewpoint", {"points": EYE[None], "weights": [1.0]}),
    ],
)
def test_what_makes_no_sense_is_refused(words: str, options: dict) -> None:
    arguments = {"points": sphere(100), "viewpoint": EYE, "weights": None, **options}
    with pytest.raises(ValueError, match=words):
        calibrate_radius(**arguments)
