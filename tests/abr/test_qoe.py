"""Equation 8 and its parts: known answers, bounds, and intervals that hold what they promise."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsvis.abr.qoe import (
    Difference,
    QoeConfig,
    first_frame,
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
    assert first_frame([0.0, 0.5, 1.0], [3.0, 20.0, 50.0]) == 0.5
    assert first_frame([0.0], [3.0]) == np.inf
    assert stall([0.0, 1.0, 2.0, 3.0], [5.0, 22.0, 30.0, 10.0]) == 2.0
    assert stall([0.0, 1.0], [22.0, 40.0], end=9.0) == 1.0


def test_each_constant_scales_its_part() -> None:
    found = quality_of_experience([20.0], [0.5], QoeConfig(psnr_scale=40.0, latency_scale=2.0, delay_weight=0.5))
    assert (found.quality, found.delay, found.score) == (0.5, 0.25, 0.375)
    assert quality_of_experience([50.0], [3.0], QoeConfig(latency_scale=2.0)).latency == 2.0
    assert quality_of_experience([50.0], [0.5], QoeConfig(delay_weight=0.0)).score == 1.0


def test_a_stall_is_what_is_worse_than_acceptable_from_the_first_image_on() -> None:
    assert stall([0.0, 1.0, 3.0, 6.0], [19.9, 20.0, 25.0, 24.9], end=10.0) == 2.0 + 4.0
    assert stall([0.0, 1.0, 3.0], [20.0, 24.9, 24.9]) == 1.0 + 2.0 + 2.0  # the last lasts as long as the one before
    assert stall([0.0, 1.0], [30.0, 34.9], least=35.0) == 2.0
    assert stall([3.0], [22.0], end=5.0) == 2.0
    assert stall([3.0], [22.0]) == stall([], []) == stall([0.0, 1.0], [19.0, 19.0]) == 0.0


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
    from scipy import stats  # seconds, which collecting should not take

    a, b = np.random.default_rng(2).normal(size=(2, 12))
    found, expected = paired_difference(a, b), stats.ttest_rel(a, b).confidence_interval(0.95)
    assert (found.low, found.high) == pytest.approx((expected.low, expected.high))
    assert not paired_difference(a, a).excludes_zero
    assert paired_difference(a + 1, a).excludes_zero
    assert paired_difference(a, b, method="bootstrap") == paired_difference(a, b, method="bootstrap")
    narrow, wide = (paired_difference(a, b, method="bootstrap", confidence=share) for share in (0.5, 0.99))
    assert wide.low < narrow.low < narrow.mean < narrow.high < wide.high
    assert (narrow.pairs, narrow.confidence, narrow.method) == (12, 0.5, "bootstrap")


@pytest.mark.parametrize(
    ("low", "high", "excludes"),
    [(0.1, 0.3, True), (-0.3, -0.1, True), (-0.1, 0.1, False), (0.0, 0.2, False), (-0.2, 0.0, False)],
)
def test_an_interval_that_touches_zero_does_not_exclude_it(low: float, high: float, excludes: bool) -> None:
    found = Difference((low + high) / 2, low, high, 9, 0.95, "t")
    assert found.excludes_zero == excludes == found.as_dict()["excludes_zero"]


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
        (lambda: paired_difference([1.0, 2.0], [1.0, 2.0], confidence=0.0), "confidence"),
        (lambda: paired_difference([1.0, 2.0], [1.0, 2.0], method="bootstrap", resamples=0), "resamples"),
        (lambda: quality_of_experience([-0.1], [0.0]), "psnr"),
        (lambda: stall([0.0, 2.0, 1.0], [30.0, 30.0, 30.0]), "times"),
        (lambda: stall([0.0, 1.0], [30.0, 30.0], end=0.5), "times"),
    ],
)
def test_wrong_arguments_are_named(make, message: str) -> None:
    with pytest.raises(ValueError, match=f"^{message}"):
        make()


@pytest.mark.parametrize("name", ["psnr_scale", "latency_scale", "shown_db", "delay_weight"])
def test_constants_that_make_no_sense_are_named(name: str) -> None:
    for value in (-1.0, np.nan, np.inf, *([0.0] if name != "delay_weight" else [])):
        with pytest.raises(ValueError, match=f"^{name}: expected a finite number"):
            QoeConfig(**{name: value})
