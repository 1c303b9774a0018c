"""Merging by pairs: counts, what goes first, laws of units and order, and the plain twin of the price."""

from __future__ import annotations

import numpy as np
import pytest

from gsvis.scene.gaussians import Gaussians
from gsvis.train import pairs
from gsvis.train._kernels.pairs import pair_up, price_neighbors
from gsvis.train.merge import mean_shadows
from gsvis.train.pairs import merge_pairs


def cloud(n: int = 300, seed: int = 3, degree: int = 1) -> Gaussians:
    rng = np.random.default_rng(seed)
    return Gaussians(
        rng.normal(size=(n, 3)) * [3.0, 2.0, 1.0],
        rng.normal(size=(n, 4)),
        np.exp(rng.normal(-3.0, 0.7, size=(n, 3))),
        rng.uniform(0.05, 0.9, size=n),
        rng.normal(size=(n, 1, 3)),
        0.1 * rng.normal(size=(n, (degree + 1) ** 2 - 1, 3)),
    )


@pytest.mark.parametrize("count", [1, 7, 150, 299])
@pytest.mark.parametrize("degree", [0, 2])
def test_a_merged_scene_has_the_count_asked_for(count: int, degree: int) -> None:
    level = merge_pairs(cloud(degree=degree), count)
    assert len(level) == count
    assert level.sh_degree == degree


def test_a_scene_that_is_small_enough_stays_as_it_is() -> None:
    g = cloud()
    assert merge_pairs(g, len(g)) is g


@pytest.mark.parametrize("count", [0, 301])
def test_a_count_out_of_range_is_refused(count: int) -> None:
    with pytest.raises(ValueError, match="count: expected 1 to 300"):
        merge_pairs(cloud(), count)


def test_colors_stay_apart_on_one_surface() -> None:
    x, y = np.meshgrid(np.arange(8.0), np.arange(8.0))
    red = (x.ravel() + y.ravel()) % 2 == 0
    colors = np.where(red[:, None], [3.0, -3.0, -3.0], [-3.0, -3.0, 3.0])[:, None]
    board = Gaussians(
        np.stack([x.ravel(), y.ravel(), np.zeros(64)], axis=1), [[1, 0, 0, 0]] * 64, [[0.6, 0.6, 0.05]] * 64,
        [0.5] * 64, colors,
    )  # fmt: skip
    level = merge_pairs(board, 32)
    assert np.abs(np.abs(level.sh0) - 3.0).max() < 1e-5


def test_twins_merge_before_all_others_and_keep_their_coverage() -> None:
    g = cloud(40)
    level = merge_pairs(Gaussians.concatenate([g, g[:10]]), 40)
    order = np.lexsort(level.means.T), np.lexsort(g.means.T)
    np.testing.assert_allclose(level.means[order[0]], g.means[order[1]], atol=1e-5)
    shadows = [each.opacities * mean_shadows(each.scales.astype(np.float64)) for each in (level, g)]
    twice = shadows[1].copy()
    twice[:10] = np.minimum(2.0 * g.opacities[:10], 0.996) * twice[:10] / g.opacities[:10]
    np.testing.assert_allclose(shadows[0][order[0]], twice[order[1]], rtol=1e-4)


def test_the_result_follows_units_and_order() -> None:
    g = cloud()
    level = merge_pairs(g, 90)
    larger = merge_pairs(g.transform(np.eye(3), scale=4.0), 90)
    np.testing.assert_allclose(larger.means, 4.0 * level.means, rtol=1e-4, atol=1e-4)
    shuffled = merge_pairs(g[np.random.default_rng(0).permutation(len(g))], 90)
    order = np.lexsort(level.means.T), np.lexsort(shuffled.means.T)
    np.testing.assert_allclose(shuffled.means[order[1]], level.means[order[0]], atol=1e-5)


def test_gaussians_in_one_place_merge_too() -> None:
    g = cloud(1)[np.zeros(60, np.int64)]
    assert len(merge_pairs(g, 3)) == 3


def test_prices_are_those_of_the_plain_twin() -> None:
    g = cloud(30)
    means = g.means.astype(np.float64)
    covars = g.covars().astype(np.float64)
    upper = np.ascontiguousarray(covars.reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]])
    weights = np.random.default_rng(0).uniform(0.1, 2.0, 30)
    colors = g.sh0[:, 0].astype(np.float64)
    near = np.tile(np.arange(30), (30, 1))
    best = np.empty((30, 4), np.int64)
    prices = np.empty((30, 4))
    price_neighbors(np.arange(30), near, means, upper, weights, colors, 0.1, best, prices)
    expected = np.full((30, 30), np.inf)
    for i in range(30):
        for j in range(30):
            if i != j:
                a, b = np.array([weights[i], weights[j]]) / (weights[i] + weights[j])
                away = means[i] - means[j]
                merged = a * covars[i] + b * covars[j] + a * b * np.outer(away, away)
                dets = [np.linalg.slogdet(each)[1] for each in (merged, covars[i], covars[j])]
                color = 0.1 * ((colors[i] - colors[j]) ** 2).sum()
                expected[i, j] = 0.5 * (dets[0] - a * dets[1] - b * dets[2]) + color
    np.testing.assert_array_equal(best, np.argsort(expected, axis=1)[:, :4])
    np.testing.assert_allclose(prices, np.sort(expected, axis=1)[:, :4], rtol=1e-9)


def test_pairs_come_in_the_order_of_prices_then_the_rest_joins() -> None:
    best = np.array([[1], [0], [1], [2]])
    groups = np.full(4, -1, np.int64)
    assert pair_up(np.array([0, 1, 2, 3]), best, 3, groups) == 2
    assert groups.tolist() == [0, 0, 1, 1]
    groups = np.full(4, -1, np.int64)
    assert pair_up(np.array([0, 1, 2, 3]), best, 1, groups) == 1
    assert groups.tolist() == [0, 0, -1, -1]
    groups = np.full(3, -1, np.int64)
    assert pair_up(np.array([0, 1, 2]), best[:3], 2, groups) == 2
    assert groups.tolist() == [0, 0, 0]


def test_a_turn_removes_at_most_half(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes: list[int] = []
    plain = pairs.merge_by_cell

    def watch(g: Gaussians, cells: np.ndarray) -> Gaussians:
        sizes.append(len(g))
        return plain(g, cells)

    monkeypatch.setattr(pairs, "merge_by_cell", watch)
    merge_pairs(cloud(), 20)
    assert all(2 * b >= a for a, b in zip(sizes, [*sizes[1:], 20], strict=True))
