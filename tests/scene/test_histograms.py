"""Histograms of a scene: every Gaussian is counted once, whatever its values; SH energy by Parseval."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from gsvis.scene.gaussians import Gaussians
from gsvis.scene.histograms import measure_bands, measure_histograms
from gsvis.scene.sh import sh_basis

NAMES = ("opacity", "log10_scale", "log10_anisotropy", "log10_distance")


def scene(means: object, scales: object, opacities: object) -> Gaussians:
    n = len(np.asarray(means))
    return Gaussians(means, np.tile([1.0, 0, 0, 0], (n, 1)), scales, opacities, np.zeros((n, 1, 3)))  # type: ignore[arg-type]


def test_known_values_lie_in_the_bins_that_name_them() -> None:
    scales = [[1, 1, 1], [1, 10, 3], [100, 50, 1], [1, 2, 1000]]
    found = measure_histograms(scene(np.eye(4)[:, :3], scales, [0.0, 0.05, 0.95, 1.0]))
    assert found["opacity"].edges == [0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0]
    assert found["opacity"].counts == [2, 0, 0, 0, 0, 0, 0, 0, 0, 2]
    assert found["opacity"].median == pytest.approx(0.5)
    for name in ("log10_scale", "log10_anisotropy"):
        each = found[name]
        assert each.edges == [0.25 * k for k in range(13)]
        assert (each.counts, each.below, each.above) == ([1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 1], 0, 0)
    assert found["log10_distance"].median == pytest.approx(0.0)  # the median of the centers is the origin


def test_outliers_are_counted_beside_the_bins_and_change_none() -> None:
    rng = np.random.default_rng(0)
    means, scales, opacities = rng.normal(size=(5000, 3)), np.exp(rng.normal(size=(5000, 3))), rng.uniform(size=5000)
    plain = measure_histograms(scene(means, scales, opacities))
    means[:3], scales[:3] = (
        [[1e30, 0, 0], [0, -3e38, 0], [0, 0, 2e4]],
        [[1e38, 1e-38, 1], [1e-30, 1e-30, 1e-37], [1, 1, 1e9]],
    )
    found = measure_histograms(scene(means, scales, opacities))
    for name in NAMES:
        assert found[name].edges == plain[name].edges
    assert found["log10_distance"].above >= 3
    assert found["log10_scale"].below >= 1


def test_equal_values_and_one_gaussian_and_none() -> None:
    for n in (0, 1, 7):
        found = measure_histograms(scene(np.zeros((n, 3)), np.ones((n, 3)), np.full(n, 0.5)))
        for name in NAMES:
            each = found[name]
            assert sum(each.counts) + each.below + each.above == n
            assert len(each.edges) == len(each.counts) + 1 >= 2
        assert found["log10_distance"].below == n  # a center at the median has no logarithm
        json.dumps({name: found[name].as_dict() for name in NAMES}, allow_nan=False)
        json.dumps([band.as_dict() for band in measure_bands(Gaussians.empty(3))], allow_nan=False)


VALUES = st.floats(float(np.finfo(np.float32).tiny), float(np.float32(3e38)), width=32)


@settings(max_examples=60, deadline=None)
@given(
    scales=arrays(np.float32, (9, 3), elements=VALUES),
    means=arrays(np.float32, (9, 3), elements=st.floats(-(2.0**127), 2.0**127, width=32)),
)
def test_every_gaussian_is_counted_once_in_ascending_bins(scales: np.ndarray, means: np.ndarray) -> None:
    found = measure_histograms(scene(means, scales, np.linspace(0, 1, 9)))
    for each in found.values():
        assert sum(each.counts) + each.below + each.above == 9
        assert (np.diff(each.edges) > 0).all()
        assert len(each.counts) <= 13
    json.dumps({name: each.as_dict() for name, each in found.items()}, allow_nan=False)


def test_the_energy_of_a_band_is_its_mean_square_over_directions() -> None:
    rng = np.random.default_rng(1)
    g = Gaussians(
        np.zeros((4, 3)),
        np.ones((4, 4)),
        np.ones((4, 3)),
        np.ones(4),
        rng.normal(size=(4, 1, 3)),
        rng.normal(size=(4, 15, 3)),
    )
    directions = rng.normal(size=(40_000, 3))
    basis = sh_basis(directions / np.linalg.norm(directions, axis=1, keepdims=True), 3)
    whole = np.concatenate([g.sh0, g.shN], axis=1)
    found = measure_bands(g)
    assert sum(band.share for band in found) == pytest.approx(1.0)
    for band in found:
        rows = slice(band.band**2, (band.band + 1) ** 2)
        values = np.einsum("dk,nkc->dnc", basis[:, rows], whole[:, rows])
        assert band.rms == pytest.approx(np.sqrt((values**2).mean()), rel=0.02)
        assert band.energy == pytest.approx((whole[:, rows] ** 2).sum() / 4, rel=1e-6)
