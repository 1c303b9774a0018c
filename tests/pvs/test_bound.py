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
from scipy.stats import beta, binom

from gsvis.pvs.bound import STAKES, upper_bound
from gsvis.pvs.reference import upper_bound_reference

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
    return 1.0 if hits == n else float(beta.ppf(1.0 - error, hits + 1, n - hits))


def allowed(repeats: int = REPEATS, error: float = ERROR) -> int:
    """Most violations that are consistent with the error: one-sided binomial test, p > 0.01."""
    return int(binom.ppf(0.99, repeats, error))


@pytest.mark.parametrize("name", DISTRIBUTIONS)
def test_the_mean_lies_below_the_bound_at_all_times(name: str) -> None:
    draw, mean = DISTRIBUTIONS[name]
    violations = 0
    for seed in range(REPEATS):
        x = draw(np.random.default_rng(seed), 400)
        violations += any(upper_bound(x[:n], error=ERROR) < mean for n in (10, 60, 400))
    assert violations <= allowed()


def test_the_ratio_of_two_means_lies_below_the_bound() -> None:
    violations = 0
    for seed in range(REPEATS):
        rng = np.random.default_rng([7, seed])
        whole = np.where(rng.random(300) < 0.5, 0.05, 1.0)  # half of the rays meet almost nothing
        part = whole * np.where(whole < 0.5, 0.2, 0.02) * rng.random(300)
        violations += upper_bound(part, whole, error=ERROR) < (0.05 * 0.1 + 0.01) / 1.05
    assert violations <= allowed()


def test_samples_of_different_means_bound_the_mean_of_the_means() -> None:
    means = np.repeat(np.linspace(0.0, 0.04, 10), 40)
    violations = 0
    for seed in range(REPEATS):
        x = (np.random.default_rng([8, seed]).random(400) < means) * 1.0
        violations += upper_bound(x, error=ERROR) < means.mean()
    assert violations <= allowed()


@pytest.mark.parametrize("name", DISTRIBUTIONS)
def test_many_samples_bring_the_bound_to_the_mean(name: str) -> None:
    draw, mean = DISTRIBUTIONS[name]
    x = draw(np.random.default_rng(1), 200_000)
    width = upper_bound(x) - x.mean()
    normal = 1.645 * x.std() / math.sqrt(len(x))
    assert 0.0 < width < 4.0 * normal + 5.0 / len(x)
    assert upper_bound(x) == pytest.approx(mean, rel=0.15)


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
