"""The upper confidence bound: coverage, laws, known answers, the plain twin, and older bounds."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.special import betaincinv

from gsvis.pvs.bound import STAKES, staged_bound, upper_bound
from gsvis.pvs.reference import upper_bound_reference
from tests.pvs.violations import most_violations

F64 = NDArray[np.float64]
Draw = Callable[[np.random.Generator, int], F64]
ERROR = 0.05
REPEATS = 300


def like_missed_light(rng: np.random.Generator, n: int) -> F64:
    """Mostly nothing, often a little, in two of a hundred cases much."""
    missed = np.where(rng.random(n) < 0.3, rng.uniform(0.0, 0.002, n), 0.0)
    return np.where(rng.random(n) < 0.02, rng.uniform(0.0, 0.5, n), missed)


# Each with its mean.
DISTRIBUTIONS: dict[str, tuple[Draw, float]] = {
    "like missed light": (like_missed_light, 0.98 * 0.3 * 0.001 + 0.02 * 0.25),
    "rare and whole": (lambda rng, n: (rng.random(n) < 0.004) * 1.0, 0.004),
    "a coin": (lambda rng, n: (rng.random(n) < 0.5) * 1.0, 0.5),
    "uniform": (lambda rng, n: rng.random(n), 0.5),
    "nearly one": (lambda rng, n: 1.0 - 0.02 * rng.random(n), 0.99),
    "small and skew": (lambda rng, n: rng.random(n) ** 20, 1.0 / 21.0),
}


def empirical_bernstein(x: F64, error: float = ERROR) -> float:
    """The bound of Maurer and Pontil, "Empirical Bernstein bounds and sample variance penalization", theorem 4."""
    log = math.log(2.0 / error)
    return float(x.mean() + math.sqrt(2.0 * x.var(ddof=1) * log / len(x)) + 7.0 * log / (3.0 * (len(x) - 1)))


def clopper_pearson(hits: int, n: int, error: float = ERROR) -> float:
    return 1.0 if hits == n else float(betaincinv(hits + 1, n - hits, 1.0 - error))


def capitals(part: F64, whole: F64, ratio: float | F64) -> F64:
    """The capital (R, n) of all players of R games after each of n samples, if they bet against a ratio."""
    gains = (part - ratio * whole) / (1.0 - ratio)
    players = [share * np.cumprod(1.0 - stake * gains, axis=1) for stake, share in STAKES]
    return np.asarray(np.sum(players, axis=0))


def violations(part: F64, whole: F64, ratio: float) -> int:
    """How many of R rows of samples have a bound below the true ratio at some time."""
    return int(np.count_nonzero((capitals(part, whole, ratio) >= 1.0 / ERROR).any(axis=1)))


@pytest.mark.parametrize("name", DISTRIBUTIONS)
def test_the_mean_lies_below_the_bound_at_all_times(name: str) -> None:
    draw, mean = DISTRIBUTIONS[name]
    x = np.stack([draw(np.random.default_rng(seed), 400) for seed in range(REPEATS)])
    assert violations(x, np.ones_like(x), mean) <= most_violations(REPEATS, ERROR)


def test_the_ratio_of_two_means_lies_below_the_bound() -> None:
    rng = np.random.default_rng(7)
    whole = np.where(rng.random((REPEATS, 300)) < 0.5, 0.05, 1.0)  # half of the rays meet almost nothing
    part = whole * np.where(whole < 0.5, 0.2, 0.02) * rng.random((REPEATS, 300))
    assert violations(part, whole, (0.05 * 0.1 + 0.01) / 1.05) <= most_violations(REPEATS, ERROR)


def test_samples_of_different_means_bound_the_mean_of_the_means() -> None:
    means = np.repeat(np.linspace(0.0, 0.04, 10), 40)
    x = (np.random.default_rng(8).random((REPEATS, 400)) < means) * 1.0
    rich = capitals(x, np.ones_like(x), float(means.mean()))[:, -1] >= 1.0 / ERROR
    assert np.count_nonzero(rich) <= most_violations(REPEATS, ERROR)


@pytest.mark.parametrize("name", DISTRIBUTIONS)
def test_the_bound_lies_below_a_ratio_where_the_capital_against_it_has_grown_enough(name: str) -> None:
    draw, mean = DISTRIBUTIONS[name]
    below = 0
    for seed in range(12):
        whole = np.random.default_rng([1, seed]).random(200) ** 0.1
        part = whole * draw(np.random.default_rng(seed), 200)
        for error in (0.05, 0.3, 0.9):
            bound = upper_bound(part, whole, error=error)
            for ratio in (mean, 0.999 * bound, min(1.001 * bound, 1.0 - 1e-9)):
                capital = capitals(part[None], whole[None], ratio)[0, -1]
                assert (bound <= ratio) == (capital >= 1.0 / error), (seed, error, ratio)
                below += bound <= ratio
    assert below > 12


@pytest.mark.parametrize("name", DISTRIBUTIONS)
def test_many_samples_bring_the_bound_to_the_mean(name: str) -> None:
    draw, mean = DISTRIBUTIONS[name]
    x = draw(np.random.default_rng(1), 200_000)
    bound = upper_bound(x)
    normal = 1.645 * x.std() / math.sqrt(len(x))
    assert 0.0 < bound - x.mean() < 4.0 * normal + 5.0 / len(x)
    assert bound == pytest.approx(mean, rel=0.15)


@given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=60), st.integers(0, 1000))
def test_the_bound_is_never_below_the_mean_and_knows_no_order(values: list[float], seed: int) -> None:
    x = np.array(values)
    bound = upper_bound(x)
    assert x.mean() <= bound <= 1.0
    assert upper_bound(np.random.default_rng(seed).permutation(x)) == pytest.approx(bound, rel=1e-6)


@given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=40), st.floats(0.0, 1.0))
def test_less_missed_light_never_raises_the_bound(values: list[float], factor: float) -> None:
    x = np.array(values)
    assert upper_bound(factor * x) <= upper_bound(x) * (1.0 + 1e-6)


@given(st.lists(st.floats(0.0, 0.2), min_size=1, max_size=40), st.floats(0.01, 0.2))
def test_a_smaller_error_never_lowers_the_bound(values: list[float], error: float) -> None:
    assert upper_bound(values, error=0.5 * error) >= upper_bound(values, error=error) * (1.0 - 1e-6)


@pytest.mark.parametrize("name", DISTRIBUTIONS)
def test_more_samples_never_widen_the_bound_much(name: str) -> None:
    x = DISTRIBUTIONS[name][0](np.random.default_rng(3), 12_800)
    widths = [upper_bound(x[:n]) - x[:n].mean() for n in 100 * 2 ** np.arange(8)]
    assert all(after <= 1.1 * before for before, after in pairwise(widths))
    assert widths[-1] < 0.5 * widths[0]


@pytest.mark.parametrize("n", [10, 100, 3000, 100_000])
def test_where_nothing_is_missed_the_bound_is_about_three_over_the_samples(n: int) -> None:
    bound = upper_bound(np.zeros(n))
    exact = clopper_pearson(0, n)  # 1 - 0.05 ** (1 / n), the best that any method can do
    assert exact <= bound <= 1.2 * exact
    assert bound == pytest.approx(1.0 - (ERROR * STAKES[0][1]) ** (1.0 / n / STAKES[0][0]), rel=0.05)


def test_where_all_is_missed_the_bound_is_one() -> None:
    assert upper_bound(np.ones(50)) == pytest.approx(1.0)


def test_without_samples_or_without_light_nothing_is_known() -> None:
    assert upper_bound([]) == 1.0
    assert upper_bound(np.zeros(1000), np.zeros(1000)) == 1.0


def test_rays_that_meet_nothing_leave_the_bound_of_the_ratio() -> None:
    part, whole = 0.1 * np.random.default_rng(0).random(500), np.ones(500)
    wider = np.concatenate([part, np.zeros(700)]), np.concatenate([whole, np.zeros(700)])
    assert upper_bound(*wider) == pytest.approx(upper_bound(part, whole), rel=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_the_plain_twin_finds_the_same(seed: int) -> None:
    rng = np.random.default_rng(seed)
    whole = rng.random(40)
    part = whole * rng.random(40) ** (1 + 3 * seed)
    steps = 20_000
    assert upper_bound(part, whole) == pytest.approx(
        upper_bound_reference(part.tolist(), whole.tolist(), ERROR, steps), abs=1.01 / steps
    )


@settings(max_examples=20)
@given(st.lists(st.sampled_from([0.0, 1e-300, 1e-9, 0.5, 1.0 - 1e-16, 1.0]), min_size=1, max_size=6))
def test_the_plain_twin_finds_the_same_at_extremes(values: list[float]) -> None:
    found, steps = upper_bound(values), 2000
    plain = upper_bound_reference(values, [1.0] * len(values), ERROR, steps)
    assert found == pytest.approx(plain, abs=1.01 / steps)


@pytest.mark.parametrize("n", [2000, 8000])
def test_it_is_far_tighter_than_empirical_bernstein_on_small_shares(n: int) -> None:
    excess = {"betting": 0.0, "bernstein": 0.0}
    for seed in range(10):
        x = like_missed_light(np.random.default_rng(seed), n) * 0.2
        excess["betting"] += upper_bound(x) - x.mean()
        excess["bernstein"] += empirical_bernstein(x) - x.mean()
    assert excess["betting"] < 0.5 * excess["bernstein"]


@pytest.mark.parametrize(("hits", "n"), [(0, 500), (5, 1000), (20, 1000), (300, 3000)])
def test_it_is_near_the_exact_bound_of_a_share_of_hits(hits: int, n: int) -> None:
    x = np.zeros(n)
    x[:hits] = 1.0
    exact = clopper_pearson(hits, n)
    assert exact < upper_bound(x)  # it holds at all times, the exact one only for this number of samples
    assert upper_bound(x) - hits / n < 2.2 * (exact - hits / n)


@pytest.mark.parametrize(
    ("part", "whole", "error", "name"),
    [
        ([0.5, -0.1], None, 0.05, "part"),
        ([0.5, 1.1], None, 0.05, "part"),
        ([0.5], [0.4], 0.05, "part"),
        ([0.5], [1.4], 0.05, "part"),
        ([0.5], [0.6, 0.7], 0.05, "whole"),
        ([float("nan")], None, 0.05, "part"),
        ([0.5], None, 0.0, "error"),
        ([0.5], None, 1.0, "error"),
    ],
)
def test_what_is_out_of_range_is_refused(part: list[float], whole: list[float] | None, error: float, name: str) -> None:
    with pytest.raises(ValueError, match=name):
        upper_bound(part, whole, error=error)


def mended(rng: np.random.Generator, stages: int, count: int) -> tuple[list[tuple[F64, F64]], list[float]]:
    """Samples of stages after each of which some of what was found is mended, and the true ratio of each stage.

    A hundred things are missed with different weights; a ray meets each with a probability, and what it meets is mended
    after the stage. So the ratio of a stage depends on the samples before it.
    """
    chance, weight = 0.002 * rng.random(100), rng.random(100) ** 3
    found, ratios = [], []
    missing = np.ones(100, bool)
    for _ in range(stages):
        met = rng.random((count, 100)) < chance
        part = np.minimum(np.where(met & missing, weight, 0.0).max(axis=1), 1.0)
        found.append((part, np.ones(count)))
        order = np.argsort(-weight[missing])  # the largest of those that are met counts
        some, rare = weight[missing][order], chance[missing][order]
        ratios.append(float(np.sum(some * rare * np.cumprod(np.concatenate([[1.0], 1.0 - rare[:-1]])))))
        missing &= ~met.any(axis=0)
    return found, ratios


def test_no_bound_of_any_stage_lies_below_its_ratio_although_stages_depend_on_each_other() -> None:
    repeats, missed = 150, 0
    for seed in range(repeats):
        found, ratios = mended(np.random.default_rng([11, seed]), 4, 100)
        assert all(after <= before for before, after in pairwise(ratios))
        missed += any(staged_bound(found[: k + 1], error=ERROR) < ratios[k] for k in range(4))
    assert missed <= most_violations(repeats, ERROR)


@pytest.mark.parametrize("ratios", [(0.3, 0.03), (0.02, 0.02), (0.5, 0.1, 0.1, 0.01)])
def test_the_last_ratio_lies_below_the_staged_bound(ratios: tuple[float, ...]) -> None:
    repeats, missed = 150, 0
    for seed in range(repeats):
        rng = np.random.default_rng([12, seed])
        stages = [((rng.random(80) < ratio) * 1.0, np.ones(80)) for ratio in ratios]
        missed += staged_bound(stages, error=ERROR) < ratios[-1]
    assert missed <= most_violations(repeats, ERROR)


def test_one_stage_is_bounded_by_most_of_the_error() -> None:
    x = like_missed_light(np.random.default_rng(0), 500)
    whole = 0.5 + 0.5 * np.random.default_rng(1).random(500)
    assert staged_bound([(x * whole, whole)]) == upper_bound(x * whole, whole, error=0.04)
    assert staged_bound([(x * whole, whole)], error=0.5) == upper_bound(x * whole, whole, error=0.4)
    assert staged_bound([]) == 1.0


def test_stages_are_no_worse_than_the_last_one_alone_with_its_share_of_the_error() -> None:
    rng = np.random.default_rng(2)
    ones = np.ones(3000)
    bad, good = (rng.random(3000) < 0.2) * 1.0, (rng.random(3000) < 0.001) * 1.0
    stages = [(bad, ones), (bad, ones), (good, ones)]
    assert staged_bound(stages) == upper_bound(good, error=0.01 / 4)  # what was mended long ago does not count
    assert staged_bound(stages) < 2.0 * upper_bound(good)
    kept = [(good, ones)] * 3  # nothing was mended: all samples count
    assert staged_bound(kept) == upper_bound(np.tile(good, 3), error=0.04)
    assert staged_bound(kept) < upper_bound(good)


STAGES = st.lists(st.lists(st.tuples(st.floats(0.0, 1.0), st.floats(0.0, 1.0)), min_size=1, max_size=12), min_size=1,
                  max_size=4)  # fmt: skip


def stages_of(values: list[list[tuple[float, float]]]) -> list[tuple[F64, F64]]:
    """(part, whole) of each stage, from pairs of a share and a weight."""
    return [
        (np.array([share * weight for share, weight in stage]), np.array([weight for _, weight in stage]))
        for stage in values
    ]


@given(STAGES, st.integers(0, 1000))
def test_a_staged_bound_is_never_below_the_last_estimate_and_knows_no_order_within_a_stage(
    values: list[list[tuple[float, float]]], seed: int
) -> None:
    stages = stages_of(values)
    bound, (part, whole) = staged_bound(stages), stages[-1]
    assert 0.0 <= bound <= 1.0
    if whole.any():
        assert bound >= min(1.0, part.sum() / whole.sum())
    rng = np.random.default_rng(seed)
    mixed = [(a[order], b[order]) for a, b in stages for order in [rng.permutation(len(a))]]
    assert staged_bound(mixed) == pytest.approx(bound, rel=1e-6)


@given(STAGES, st.floats(0.0, 1.0), st.floats(0.01, 1.0))
def test_less_missed_light_and_a_larger_error_never_raise_a_staged_bound(
    values: list[list[tuple[float, float]]], factor: float, error: float
) -> None:
    stages = stages_of(values)
    bound = staged_bound(stages, error=0.5 * error)
    assert staged_bound([(factor * part, whole) for part, whole in stages], error=0.5 * error) <= bound * (1.0 + 1e-6)
    assert staged_bound(stages, error=0.25 * error) >= bound * (1.0 - 1e-6)


def test_a_last_stage_without_light_leaves_the_bound_of_those_before() -> None:
    part, whole = 0.01 * np.ones(400), np.ones(400)
    dark = np.zeros(50), np.zeros(50)
    assert staged_bound([(part, whole), dark]) == pytest.approx(staged_bound([(part, whole)]), rel=1e-6)
    assert staged_bound([dark, dark]) == 1.0


def test_stages_out_of_range_are_refused() -> None:
    for stages in ([([0.5], [0.4])], [([0.1], [1.0]), ([0.5], [0.4])], [([0.1], [1.0, 1.0])]):
        with pytest.raises(ValueError, match="whole"):
            staged_bound(stages)
    with pytest.raises(ValueError, match="error"):
        staged_bound([([0.1], [1.0])], error=0.0)
