from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsvis.color.epsilon import (
    FLIP_JND,
    MetricObserver,
    Staircase,
    StaircaseRule,
    calibrate_epsilon,
    replay,
)

SMALL = StaircaseRule(0.1, 0.3, (2, 2), 2, 8, 60, 0.002, 0.4)


class Simulated:
    """An observer with a known psychometric function of log epsilon."""

    name = "simulated"
    provenance: Mapping[str, Any] = {"of": "a test"}

    def __init__(self, middle: float, spread: float, guess: float, seed: int) -> None:
        self.middle, self.spread, self.guess = math.log(middle), spread, guess
        self.rng = np.random.default_rng(seed)

    def __call__(self, epsilon: float) -> bool:
        noticed = 0.5 * (1.0 + math.tanh(0.5 * (math.log(epsilon) - self.middle) / self.spread))
        return bool(self.rng.random() < self.guess + (1.0 - self.guess) * noticed)

    @property
    def answer(self) -> float:
        """Where three of four trials are detected."""
        q = (0.75 - self.guess) / (1.0 - self.guess)
        return math.exp(self.middle + self.spread * math.log(q / (1.0 - q)))


class Always:
    name = "always"
    provenance: Mapping[str, Any] = {}

    def __init__(self, answer: bool) -> None:
        self.answer = answer

    def __call__(self, epsilon: float) -> bool:
        return self.answer


def threshold(at: float) -> MetricObserver:
    return MetricObserver(lambda epsilon: epsilon, at)


@pytest.mark.parametrize(
    ("spread", "guess", "bias", "deviation"),
    [(0.1, 0.0, 0.06, 0.05), (0.4, 0.0, 0.06, 0.11), (0.1, 0.5, 0.03, 0.09), (0.4, 0.5, 0.03, 0.17)],
)
def test_the_point_of_75_percent_is_found(spread: float, guess: float, bias: float, deviation: float) -> None:
    middles = 0.02 * np.exp(np.linspace(-0.5, 0.5, 100))
    observers = [Simulated(middle, spread, guess, seed) for seed, middle in enumerate(middles.tolist())]
    found = [calibrate_epsilon(observer) for observer in observers]
    errors = np.log([f.epsilon / o.answer for f, o in zip(found, observers, strict=True)])
    assert all(f.converged for f in found)
    assert abs(errors.mean()) < bias
    assert errors.std() < deviation
    assert max(len(f.epsilons) for f in found) < 200
    stated = np.sqrt(np.mean([f.standard_error**2 for f in found]))
    assert 0.6 < stated / errors.std() < 1.3


def test_smaller_steps_end_closer_to_the_point() -> None:
    def mean_error(down_step: float) -> float:
        rule = StaircaseRule(down_step=down_step)
        observers = [Simulated(0.02, 0.3, 0.0, seed) for seed in range(60)]
        return float(np.mean([math.log(calibrate_epsilon(o, rule).epsilon / o.answer) for o in observers]))

    assert mean_error(0.4) > 2.0 * abs(mean_error(0.05))


@settings(max_examples=30)
@given(st.floats(math.log(5e-4), math.log(0.5)), st.sampled_from([0.01, 0.05, math.log(2.0) / 8.0]))
def test_an_observer_without_spread_is_found_one_step_above_the_threshold(logarithm: float, step: float) -> None:
    rule = StaircaseRule(down_step=step, coarse=(32, 32, 8, 8, 2, 2), max_trials=1000)
    found = calibrate_epsilon(threshold(math.exp(logarithm)), rule)
    assert found.converged
    assert 0.5 * step - 1e-9 <= math.log(found.epsilon) - logarithm <= 1.5 * step + 1e-9
    assert found.standard_error == pytest.approx(step / math.sqrt(12.0))


@pytest.mark.parametrize(("answer", "epsilon"), [(True, 1e-4), (False, 1.0)])
def test_whoever_always_or_never_detects_ends_at_a_bound(answer: bool, epsilon: float) -> None:
    found = calibrate_epsilon(Always(answer))
    assert not found.converged
    assert found.epsilon == pytest.approx(epsilon)
    assert (
        found.reason
        == f"{'noticed even at the lowest' if answer else 'not noticed even at the highest'} epsilon, "
        + ("0.0001" if answer else "1")
    )
    assert math.isnan(found.standard_error)
    assert len(found.epsilons) < 40
    assert len(found.reversals) == 0


def test_whoever_only_guesses_does_not_converge() -> None:
    guesses = [calibrate_epsilon(Simulated(1e6, 0.1, 0.5, seed), SMALL) for seed in range(50)]
    assert sum(found.converged for found in guesses) <= 5
    assert all(found.epsilon > 0.1 for found in guesses)


def test_too_few_trials_do_not_converge() -> None:
    rule = StaircaseRule(max_trials=30)
    found = calibrate_epsilon(threshold(0.02), rule)
    assert not found.converged
    assert found.reason == f"{len(found.reversals)} reversals in 30 trials are too few"
    assert 0.01 < found.epsilon < 0.05
    assert Staircase(rule).result().epsilon == pytest.approx(0.1)


@settings(max_examples=60)
@given(st.lists(st.booleans(), min_size=1, max_size=80), st.sampled_from([StaircaseRule(), SMALL]))
def test_one_step_down_three_up_within_the_bounds(answers: list[bool], rule: StaircaseRule) -> None:
    staircase = Staircase(rule)
    epsilons = []
    for answer in answers:
        if staircase.finished:
            break
        epsilons.append(staircase.epsilon)
        staircase.answer(answer)
    found = staircase.result()
    assert found.epsilons.tolist() == epsilons
    assert rule.lowest <= min(epsilons)
    assert max(epsilons) <= rule.highest
    assert epsilons[0] == pytest.approx(rule.start)
    turned = 0
    for before, after, trial in zip(epsilons, [*epsilons[1:], staircase.epsilon], range(len(epsilons)), strict=True):
        turned += trial > 0 and answers[trial] != answers[trial - 1]
        size = (rule.coarse[turned] if turned < len(rule.coarse) else 1) * rule.down_step
        wanted = before * math.exp(-size if answers[trial] else 3.0 * size)
        assert after == pytest.approx(min(max(wanted, rule.lowest), rule.highest), rel=rule.down_step)
        if rule.lowest < wanted < rule.highest and rule.lowest < before < rule.highest:
            assert after == pytest.approx(wanted)
    assert len(found.reversals) == turned


def test_the_estimate_is_the_geometric_mean_of_as_many_highs_as_lows() -> None:
    found = calibrate_epsilon(Simulated(0.02, 0.3, 0.0, seed=7))
    counted = found.epsilons[found.reversals[-found.counted :]]
    assert found.counted == StaircaseRule().reversals
    assert found.epsilon == pytest.approx(np.exp(np.log(counted).mean()))
    low, high = found.interval
    assert low < found.epsilon < high
    assert low * high == pytest.approx(found.epsilon**2)


def test_a_replay_gives_the_same_and_refuses_trials_that_no_rule_gives() -> None:
    found = calibrate_epsilon(Simulated(0.02, 0.3, 0.0, seed=3))
    again = replay(found.rule, found.epsilons, found.detected, found.provenance)
    assert again.as_dict() == found.as_dict()
    assert again.provenance == {"observer": "simulated", "of": "a test"}
    wrong = found.epsilons.copy()
    wrong[5] *= 1.01
    with pytest.raises(ValueError, match=r"epsilons: expected .* at trial 5 by the rule, got"):
        replay(found.rule, wrong, found.detected)
    more = [*found.epsilons, found.epsilons[-1]]
    with pytest.raises(ValueError, match=f"expected {len(more) - 1} trials, after which the staircase ends, got"):
        replay(found.rule, more, [*found.detected, True])
    with pytest.raises(ValueError, match="detected: expected bool of shape"):
        replay(found.rule, found.epsilons, found.detected[1:])


def test_results_are_json() -> None:
    for found in (calibrate_epsilon(threshold(0.02)), calibrate_epsilon(Always(True))):
        document = json.loads(json.dumps(found.as_dict(), allow_nan=False))
        assert document["format"] == "gsvis-epsilon"
        rule = StaircaseRule(**document["rule"])
        assert rule == found.rule
        epsilons, detected = zip(*document["trials"], strict=True)
        assert replay(rule, epsilons, detected).epsilon == found.epsilon


def test_rungs_fall_from_the_highest_to_the_lowest_by_equal_ratios() -> None:
    rule = StaircaseRule()
    rungs = rule.rungs
    assert rungs[0] == pytest.approx(1.0)
    assert rungs[-1] == pytest.approx(1e-4)
    assert rungs[rule.above] == rule.start
    assert len(rungs) == rule.above + rule.below + 1
    assert np.allclose(np.diff(np.log(rungs[1:-1])), -rule.down_step)


def test_the_metric_is_asked_once_an_epsilon() -> None:
    asked: list[float] = []

    def difference(epsilon: float) -> float:
        asked.append(epsilon)
        return 2.0 * epsilon

    observer = MetricObserver(difference, 0.1, slope=0.3, guess=0.5, rng=4, images={"scene": "a"})
    found = calibrate_epsilon(observer)
    assert len(asked) == len(set(asked)) == len(observer.differences)
    assert observer.differences[asked[0]] == 2.0 * asked[0]
    assert found.provenance == {
        "observer": "flip",
        "threshold": 0.1,
        "slope": 0.3,
        "guess": 0.5,
        "seed": 4,
        "images": {"scene": "a"},
    }
    assert found.epsilon == pytest.approx(0.05, rel=0.35)


def test_the_psychometric_function_of_the_metric() -> None:
    observer = MetricObserver(lambda epsilon: epsilon, 0.1, slope=0.2, guess=0.5)
    assert observer.probability(0.1) == pytest.approx(0.75)
    assert observer.probability(1e-6) == pytest.approx(0.5)
    assert observer.probability(1.0) == pytest.approx(1.0, abs=1e-4)
    plain = MetricObserver(lambda epsilon: epsilon, 0.1, slope=0.2)
    assert plain.probability(0.1 * 3.0**0.2) == pytest.approx(0.75)
    assert MetricObserver(lambda epsilon: 0.0, 0.1, slope=0.2, guess=0.25).probability(0.5) == 0.25
    step = threshold(0.1)
    assert [step.probability(epsilon) for epsilon in (0.09, 0.1, 0.11)] == [0.0, 0.0, 1.0]


def test_the_flip_threshold_is_a_just_noticeable_step_of_lightness() -> None:
    pytest.importorskip("flip_evaluator")
    from gsvis.render.metrics import flip

    def gray(lightness: float) -> float:
        linear = ((lightness + 16.0) / 116.0) ** 3
        return float(1.055 * linear ** (1.0 / 2.4) - 0.055)

    for lightness in (20.0, 50.0, 80.0):
        images = (np.full((8, 8, 3), gray(lightness + more)) for more in (2.3, 0.0))
        assert flip(*images) == pytest.approx(FLIP_JND, rel=0.05)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"start": 2.0}, "start: expected a value in"),
        ({"start": math.nan}, "start: expected a value in"),
        ({"lowest": 0.0}, "expected 0 < lowest < highest <= 1"),
        ({"highest": 1.5}, "expected 0 < lowest < highest <= 1"),
        ({"down_step": 0.0}, "down_step: expected a value in"),
        ({"coarse": 3}, "coarse: expected integers"),
        ({"coarse": (0,)}, "coarse: expected an integer of at least 1"),
        ({"discard": 3}, "discard: expected an integer of at least 6"),
        ({"reversals": 7}, "reversals: expected an even number"),
        ({"max_trials": 0}, "max_trials: expected an integer of at least 1"),
    ],
)
def test_rules_out_of_range_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        StaircaseRule(**options)


def test_observers_out_of_range_are_refused() -> None:
    with pytest.raises(ValueError, match="threshold: expected a finite number > 0, got 0"):
        MetricObserver(abs, 0.0)
    with pytest.raises(ValueError, match="slope: expected None or a finite number > 0"):
        MetricObserver(abs, 0.1, slope=-1.0)
    with pytest.raises(ValueError, match="guess: expected a probability in"):
        MetricObserver(abs, 0.1, guess=0.75)
    with pytest.raises(ValueError, match=r"difference: expected a finite number >= 0 at epsilon 0\.1, got nan"):
        calibrate_epsilon(MetricObserver(lambda epsilon: math.nan, 0.1))
