"""Equation 8 and its parts: known answers, bounds, and intervals that hold what they promise."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from gsvis.abr.qoe import (
    QoeConfig,
    first_frame,
    latencies,
    paired_difference,
    quality_of_experience,
    stall,
)

STEPS = st.lists(st.tuples(st.floats(0, 80), st.floats(0, 3)), min_size=1, max_size=20)


def test_known_answers() -> None:
    found = quality_of_experience([50.0, np.inf, 0.0, 25.0], [0.0, 0.5, np.inf, 2.0])
    assert found.quality == 0.625
    assert found.delay == 0.625
    assert found.score == 0.625 - 5 * 0.625
    assert found.psnr == (50 + 100 + 0 + 25) / 4
    assert found.latency == 0.625
    assert latencies([0.0, 1.0, 2.0], [0.25, -np.inf, np.inf]).tolist() == [0.25, 0.0, 1.0]
    assert first_frame([0.0, 0.5, 1.0], [3.0, 20.0, 50.0]) == 0.5
    assert first_frame([0.0], [3.0]) == np.inf
    assert stall([0.0, 1.0, 2.0, 3.0], [5.0, 22.0, 30.0, 10.0]) == 2.0
    assert stall([0.0, 1.0], [22.0, 40.0], end=9.0) == 1.0


@given(STEPS)
def test_the_score_is_bounded_and_made_of_its_parts(steps) -> None:
    psnr, latency = np.array(steps).T
    found = quality_of_experience(psnr, latency)
    assert 0 <= found.quality <= 1
    assert 0 <= found.delay <= 1
    assert found.score == found.quality - 5 * found.delay
    assert quality_of_experience(psnr + 1, latency).score >= found.score
    assert quality_of_experience(psnr, latency + 0.1).score <= found.score


@pytest.mark.parametrize("method", ["t", "bootstrap"])
def test_intervals_hold_the_truth_about_as_often_as_they_say(method: str) -> None:
    rng = np.random.default_rng(1)
    held = 0
    for trial in range(200):
        shared = rng.normal(0, 5, 40)
        found = paired_difference(
            shared + 0.3 + rng.normal(0, 1, 40), shared, method=method, resamples=500, seed=trial, confidence=0.9
        )
        held += found.low <= 0.3 <= found.high
    assert 0.82 <= held / 200 <= 0.96


def test_the_t_interval_is_that_of_scipy() -> None:
    a, b = np.random.default_rng(2).normal(size=(2, 12))
    found, expected = paired_difference(a, b), stats.ttest_rel(a, b).confidence_interval(0.95)
    assert (found.low, found.high) == pytest.approx((expected.low, expected.high))
    assert not paired_difference(a, a).excludes_zero
    assert paired_difference(a + 1, a).excludes_zero
    assert paired_difference(a, b, method="bootstrap") == paired_difference(a, b, method="bootstrap")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: quality_of_experience([], []), "psnr"),
        (lambda: quality_of_experience([np.nan], [0.0]), "psnr"),
        (lambda: quality_of_experience([1.0], [-1.0]), "latency"),
        (lambda: quality_of_experience([1.0], [1.0, 2.0]), "psnr"),
        (lambda: paired_difference([1.0], [1.0]), "first"),
        (lambda: paired_difference([1.0, 2.0], [1.0]), "second"),
        (lambda: paired_difference([1.0, 2.0], [1.0, 2.0], method="z"), "method"),
        (lambda: paired_difference([1.0, 2.0], [1.0, 2.0], confidence=1.0), "confidence"),
        (lambda: latencies([0.0], [np.nan]), "arrivals"),
        (lambda: QoeConfig(psnr_scale=0.0), "psnr_scale"),
    ],
)
def test_wrong_arguments_are_named(make, message: str) -> None:
    with pytest.raises(ValueError, match=f"^{message}"):
        make()
