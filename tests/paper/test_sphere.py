"""Functions on the sphere by few lobes: what is made of lobes is found again, more terms never fit worse."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from paper.sphere import SphereConfig, SphereFit, fit_function

from gsvis.color import srbf
from gsvis.scene.icosphere import face_directions, face_shares

X = face_directions(4).reshape(-1, 3)
SHARES = face_shares(4).ravel()
F64 = NDArray[np.float64]


def three_lobes() -> F64:
    """Two bright lobes and a dark one, with no mean."""
    centers = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [-0.6, -0.8, 0.0]])
    lobes = srbf(X[:, None], centers, [6.0, 12.0, 3.0])
    mean = SHARES @ lobes
    return lobes @ np.array([1.0, 0.6, -(mean[0] + 0.6 * mean[1]) / mean[2]])


def mixture(x: F64) -> F64:
    return np.tanh(3.0 * x[:, 2]) + 0.5 * x[:, 0] * x[:, 1] + np.exp(20.0 * (x[:, 0] - 1.0))


@pytest.fixture(scope="module")
def fit() -> SphereFit:
    return fit_function(mixture(X), X, max_terms=6, weights=SHARES)


def test_a_sum_of_three_lobes_is_found_by_three_terms() -> None:
    found = fit_function(three_lobes(), X, max_terms=3, weights=SHARES, config=SphereConfig(steps=200, tolerance=1e-6))
    assert found.base == pytest.approx(0.0, abs=1e-12)
    assert found.errors[3] < 1e-8 * found.errors[0]
    assert np.sort(found.decays[3]) == pytest.approx([3.0, 6.0, 12.0], rel=1e-3)


def test_the_error_falls_with_the_terms(fit: SphereFit) -> None:
    assert (np.diff(fit.errors) < 0.0).all()
    assert fit.errors[0] == pytest.approx(SHARES @ (mixture(X) - fit.base) ** 2)
    assert fit.errors[6] < 0.01 * fit.errors[0]


def test_errors_are_those_of_what_is_evaluated(fit: SphereFit) -> None:
    for k in range(7):
        assert SHARES @ (fit.evaluate(X, k) - mixture(X)) ** 2 == pytest.approx(fit.errors[k], rel=1e-9)
    assert fit.evaluate(X) == pytest.approx(fit.evaluate(3.0 * X, 6))


def test_records_are_terms_and_nothing_beyond_their_number(fit: SphereFit) -> None:
    assert fit.max_terms == 6
    for k in range(7):
        used = int(fit.counts[k])
        assert used <= k
        assert np.linalg.norm(fit.centers[k, :used], axis=1) == pytest.approx(1.0)
        assert (fit.decays[k, :used] > 0.0).all()
        for array in (fit.centers, fit.decays, fit.intensities):
            assert not array[k, used:].any()


def test_refinement_fits_better_than_atoms(fit: SphereFit) -> None:
    on_atoms = fit_function(mixture(X), X, max_terms=6, weights=SHARES, config=SphereConfig(refine=False))
    assert (np.diff(on_atoms.errors) <= 0.0).all()
    assert (fit.errors[1:] <= on_atoms.errors[1:]).all()
    assert SHARES @ (on_atoms.evaluate(X, 4) - mixture(X)) ** 2 == pytest.approx(on_atoms.errors[4], rel=1e-9)


def test_a_turned_function_has_a_turned_fit(fit: SphereFit) -> None:
    turned, _ = np.linalg.qr(np.random.default_rng(4).normal(size=(3, 3)))
    other = fit_function(mixture(X), X @ turned, max_terms=2, weights=SHARES)
    assert other.errors[:3] == pytest.approx(fit.errors[:3], rel=0.01)
    assert other.evaluate(X @ turned, 2) == pytest.approx(fit.evaluate(X, 2), abs=0.05)


def test_offset_and_scale_go_through(fit: SphereFit) -> None:
    other = fit_function(5.0 - 100.0 * mixture(X), X, max_terms=6, weights=SHARES)
    assert other.errors == pytest.approx(1e4 * fit.errors, rel=0.02)


def test_more_searches_are_no_worse_and_repeatable() -> None:
    config = SphereConfig(searches=3, seed=1)
    first, again = (fit_function(mixture(X), X, max_terms=3, weights=SHARES, config=config) for _ in range(2))
    assert np.array_equal(first.intensities, again.intensities)
    assert (first.errors <= fit_function(mixture(X), X, max_terms=3, weights=SHARES).errors * 1.001).all()


def test_no_terms() -> None:
    found = fit_function(mixture(X), X, max_terms=0, weights=SHARES)
    assert found.centers.shape == (1, 0, 3)
    assert found.evaluate(X).tolist() == [found.base] * len(X)


@pytest.mark.parametrize("value", [0.0, 3.0, -1e-20, 1e20])
def test_a_constant_needs_no_terms(value: float) -> None:
    found = fit_function(np.full(len(X), value), X, max_terms=2)
    assert found.base == pytest.approx(value)
    assert found.counts.tolist() == [0, 0, 0]
    assert found.evaluate(X) == pytest.approx(np.full(len(X), value))


def test_directions_of_no_weight_have_no_say() -> None:
    weights, values = SHARES * (X[:, 2] > 0.0), mixture(X)
    spoilt = np.where(weights > 0.0, values, 1e6)
    found, other = (fit_function(v, X, max_terms=2, weights=weights) for v in (values, spoilt))
    assert np.array_equal(found.errors, other.errors)


@pytest.mark.parametrize("count", [1, 3, 7])
def test_few_directions_get_few_terms(count: int) -> None:
    found = fit_function(np.arange(count, dtype=float), X[:count], max_terms=5)
    assert found.counts.max() <= count // 4
    assert np.isfinite(found.evaluate(X)).all()


def test_a_function_found_exactly_gets_no_more_terms() -> None:
    lobe = srbf(X, [0.0, 0.0, 1.0], 4.0) - srbf(X, [0.0, 0.0, -1.0], 4.0)
    found = fit_function(lobe, X, max_terms=5, weights=SHARES, config=SphereConfig(steps=200, tolerance=1e-9))
    assert found.errors[5] < 1e-10 * found.errors[0]
    assert np.isfinite(found.intensities).all()


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("values", {"values": np.zeros(5)}),
        ("values", {"values": np.where(X[:, 0] > 0.9, np.nan, 1.0)}),
        ("directions", {"directions": np.zeros((len(X), 3))}),
        ("weights", {"weights": np.zeros(len(X))}),
        ("weights", {"weights": -SHARES}),
        ("max_terms", {"max_terms": -1}),
    ],
)
def test_bad_arguments_are_named(name: str, change: dict[str, Any]) -> None:
    given = {"values": X[:, 0], "directions": X, "max_terms": 1, **change}
    with pytest.raises(ValueError, match=f"^{name}: "):
        fit_function(given.pop("values"), given.pop("directions"), **given)


@pytest.mark.parametrize(
    ("name", "value"),
    [("ridge", 0.0), ("tolerance", -1.0), ("subdivisions", 5), ("searches", 0), ("max_decay", 0.5), ("steps", -1)],
)
def test_bad_limits_are_named(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"^{name}: "):
        SphereConfig(**{name: value})


def test_bad_terms_are_named(fit: SphereFit) -> None:
    with pytest.raises(ValueError, match=r"^terms: expected 0 to 6"):
        fit.evaluate(X, 7)
