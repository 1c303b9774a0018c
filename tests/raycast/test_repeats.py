"""Exact repeats are ties: both searches find all of them, and their order and number on a ray do not count."""

from __future__ import annotations

import numpy as np
import pytest

from gsvis.raycast import EllipsoidProxies, Tracer, cross_check
from gsvis.raycast.second_tracer import compare
from gsvis.raycast.tracer import Contributions
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.repeats import first_equal

COPIES = 120


def repeated(seed: int = 0) -> Gaussians:
    """Five faint Gaussians, each many times."""
    rng = np.random.default_rng(seed)
    which = np.repeat(np.arange(5), COPIES)
    means, scales, quats = rng.uniform(-1, 1, (5, 3)), rng.uniform(0.1, 0.3, (5, 3)), rng.normal(size=(5, 4))
    return Gaussians(
        means[which], quats[which], scales[which], np.full(len(which), 0.006), np.zeros((len(which), 1, 3))
    )


def rays(g: Gaussians, count: int = 200) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    origins = rng.normal(size=(count, 3)) * 2.0
    return origins, g.means[rng.integers(0, len(g), count)] - origins


def test_the_first_of_equals_is_named() -> None:
    g = repeated()
    np.testing.assert_array_equal(first_equal(g), np.repeat(np.arange(5) * COPIES, COPIES))
    order = np.random.default_rng(2).permutation(len(g))
    shuffled = g[order]
    np.testing.assert_array_equal(shuffled.means[first_equal(shuffled)], shuffled.means)


def test_both_searches_find_every_repeat() -> None:
    g = repeated()
    tracer = Tracer(EllipsoidProxies.from_scene(g))
    one, other = tracer.contributions(*rays(g)), tracer.contributions(*rays(g), search="faces")
    assert len(one.weights) > 200 * COPIES
    np.testing.assert_array_equal(one.ray_offsets, other.ray_offsets)
    np.testing.assert_allclose(np.sort(one.weights), np.sort(other.weights), atol=1e-6)


def test_two_tracers_agree_on_repeats_in_any_order() -> None:
    g = repeated()
    g = g[np.random.default_rng(3).permutation(len(g))]
    found = cross_check(Tracer(EllipsoidProxies.from_scene(g)), *rays(g))
    assert found is not None
    assert found.agreeing == found.rays


def contributions(ids: list[int], weights: list[float]) -> Contributions:
    count = len(ids)
    shares = np.array(weights, np.float32)
    depths = np.arange(count, dtype=np.float32)
    return Contributions(np.array([0, count]), np.array(ids), shares, shares, depths)


@pytest.mark.parametrize(
    ("other", "agrees"),
    [
        (([1, 0, 2], [0.3, 0.2, 0.4]), True),  # twins swapped
        (([0, 2], [0.5, 0.4]), True),  # one twin holds the light of both
        (([2, 0, 1], [0.4, 0.3, 0.2]), False),  # another order
        (([0, 1, 2], [0.3, 0.1, 0.4]), False),  # light is missing
        (([0, 1], [0.3, 0.2]), False),
    ],
)
def test_weights_are_summed_over_ties(other: tuple[list[int], list[float]], agrees: bool) -> None:
    ties = np.array([0, 0, 2])  # 0 and 1 are equal
    found = compare(contributions([0, 1, 2], [0.3, 0.2, 0.4]), contributions(*other), ties)
    assert bool(found.agreeing) == agrees
