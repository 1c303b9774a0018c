"""Merged Gaussians: counts, moments, coverage; one voxel each is the scene itself."""

from __future__ import annotations

import numpy as np
import pytest

from gsvis.scene.gaussians import Gaussians
from gsvis.train.merge import _cells_for, merge_by_cell, merge_gaussians, occupied_voxels


def cloud(n: int = 600, seed: int = 3, degree: int = 1) -> Gaussians:
    rng = np.random.default_rng(seed)
    return Gaussians(
        rng.normal(size=(n, 3)) * [3.0, 2.0, 1.0],
        rng.normal(size=(n, 4)),
        np.exp(rng.normal(-3.0, 0.7, size=(n, 3))),
        rng.uniform(0.05, 0.9, size=n),
        rng.normal(size=(n, 1, 3)),
        0.1 * rng.normal(size=(n, (degree + 1) ** 2 - 1, 3)),
    )


@pytest.mark.parametrize("count", [1, 7, 150, 300, 599, 600])
@pytest.mark.parametrize("degree", [0, 1])
def test_a_merged_scene_has_the_count_asked_for(count: int, degree: int) -> None:
    level = merge_gaussians(cloud(degree=degree), count)
    assert len(level) == count
    assert level.sh_degree == degree


def test_a_merged_scene_with_a_voxel_for_each_is_the_scene() -> None:
    g = cloud()
    level = merge_gaussians(g, len(g))
    back = np.lexsort(level.means.T), np.lexsort(g.means.T)
    for name in ("means", "quats", "scales", "opacities", "sh0", "shN"):
        np.testing.assert_array_equal(getattr(level, name)[back[0]], getattr(g, name)[back[1]])


def test_moments_of_a_cell_are_those_of_its_mixture() -> None:
    one = Gaussians(
        [[5.0, 0, 0], [7.0, 0, 0]], [[1, 0, 0, 0]] * 2, [[0.5] * 3] * 2, [0.4, 0.4], [[[0.0] * 3], [[1.0] * 3]]
    )
    level = merge_by_cell(one, np.zeros(2, np.int64))
    np.testing.assert_allclose(level.means, [[6, 0, 0]], atol=1e-6)
    np.testing.assert_allclose(level.covars()[0], np.diag([1.25, 0.25, 0.25]), atol=1e-6)
    np.testing.assert_allclose(level.sh0, [[[0.5] * 3]], atol=1e-6)
    shadow = np.pi * ((2 * (1.25 * 0.25) ** 0.8 + 0.25**1.6) / 3) ** (1 / 1.6)
    np.testing.assert_allclose(level.opacities, [2 * 0.4 * np.pi * 0.25 / shadow], rtol=1e-5)


def test_moments_of_any_cells_are_those_of_their_mixtures() -> None:
    g, cells = cloud(60), np.random.default_rng(1).permutation(np.arange(60) % 7)
    level = merge_by_cell(g, cells)
    shadows = (
        np.pi * np.mean([(g.scales[:, i] * g.scales[:, j]) ** 1.6 for i, j in ((0, 1), (1, 2), (2, 0))], 0) ** 0.625
    )
    for cell in range(7):
        own = cells == cell
        weights = g.opacities[own] * shadows[own]
        mean = np.average(g.means[own], axis=0, weights=weights)
        away = g.means[own] - mean
        covars = g.covars()[own] + away[:, :, None] * away[:, None, :]
        np.testing.assert_allclose(level.means[cell], mean, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(
            level.covars()[cell], np.average(covars, axis=0, weights=weights), rtol=1e-4, atol=1e-5
        )
        np.testing.assert_allclose(
            level.shN[cell], np.average(g.shN[own], axis=0, weights=weights), rtol=1e-4, atol=1e-6
        )


@pytest.mark.parametrize("part", [1, 7, 40])
def test_the_size_of_parts_changes_no_bit(part: int, monkeypatch: pytest.MonkeyPatch) -> None:
    g, cells = cloud(600), np.random.default_rng(2).permutation(np.arange(600) ** 2 // 7200)
    cells = np.unique(cells, return_inverse=True)[1]  # cells of 1 to 85
    whole = merge_by_cell(g, cells)
    monkeypatch.setattr("gsvis.train.merge._PART", part)
    parts = merge_by_cell(g, cells)
    for name in ("means", "quats", "scales", "opacities", "sh0", "shN"):
        assert np.array_equal(getattr(whole, name), getattr(parts, name)), name


def test_the_thinnest_axis_is_a_millionth_of_the_longest_at_least() -> None:
    flat = Gaussians(
        [[-9.0, 0, 0], [9.0, 0, 0]], [[1, 0, 0, 0]] * 2, [[5.0, 5.0, 1e-8]] * 2, [0.5] * 2, np.zeros((2, 1, 3))
    )
    scales = merge_by_cell(flat, np.zeros(2, np.int64)).scales[0]
    np.testing.assert_allclose(np.sort(scales), [1e-6 * np.sqrt(106.0), 5.0, np.sqrt(106.0)], rtol=1e-5)


def test_what_covers_little_counts_little_and_opacity_has_a_top() -> None:
    pair = Gaussians([[0.0, 0, 0], [1.0, 0, 0]], [[1, 0, 0, 0]] * 2, [[0.3] * 3] * 2, [0.0, 1.0], np.zeros((2, 1, 3)))
    level = merge_by_cell(pair, np.zeros(2, np.int64))
    np.testing.assert_allclose(level.means, [[1, 0, 0]], atol=1e-6)
    same = Gaussians([[0.0, 0, 0]] * 3, [[1, 0, 0, 0]] * 3, [[0.3] * 3] * 3, [0.9] * 3, np.zeros((3, 1, 3)))
    assert merge_by_cell(same, np.zeros(3, np.int64)).opacities[0] == pytest.approx(0.996)


def test_a_merged_scene_follows_a_scale_of_the_scene_and_a_shuffle() -> None:
    g = cloud()
    level, larger = merge_gaussians(g, 200), merge_gaussians(g.transform(np.eye(3), scale=4.0), 200)
    np.testing.assert_allclose(larger.means, 4.0 * level.means, rtol=1e-4, atol=1e-5)
    shuffled = merge_gaussians(g[np.random.default_rng(0).permutation(len(g))], 200)
    np.testing.assert_allclose(shuffled.means, level.means, atol=1e-5)


def test_a_merged_scene_follows_a_shift_of_the_scene() -> None:
    g = cloud()
    exact = Gaussians(np.round(64.0 * g.means) / 64.0, g.quats, g.scales, g.opacities, g.sh0, g.shN)
    level, moved = merge_gaussians(exact, 200), merge_gaussians(exact.transform(np.eye(3), [40.0, -8.0, 24.0]), 200)
    np.testing.assert_allclose(moved.means - [40.0, -8.0, 24.0], level.means, atol=1e-5)


@pytest.mark.parametrize("count", [10, 37, 50, 75, 99, 150, 300])
def test_voxels_are_at_most_a_hundredth_more_than_asked_for(count: int) -> None:
    assert count <= _cells_for(cloud(), count).max() + 1 <= 1.01 * count


def test_the_voxels_that_cover_least_are_left_out() -> None:
    corners = np.stack(np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0]), axis=-1).reshape(
        -1, 3
    )  # 8 voxels of any side
    radii = np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8])
    coverage = np.array([3.0, 9.0, 4.0, 7.0, 2.0, 8.0, 5.0, 6.0]) / 1000.0
    opacities = coverage / radii**2
    g = Gaussians(corners, [[1, 0, 0, 0]] * 8, np.repeat(radii[:, None], 3, 1), opacities, np.zeros((8, 1, 3)))
    np.testing.assert_array_equal(merge_gaussians(g, 5).means, corners[[1, 5, 3, 7, 6]])


@pytest.mark.parametrize("side", [0.3, 1.0, 7.0])
def test_a_voxel_is_a_cube_of_the_grid(side: float) -> None:
    points = np.random.default_rng(2).normal(scale=5.0, size=(2000, 3))
    wanted = np.unique(np.floor(points / side), axis=0, return_inverse=True)[1].reshape(-1)
    np.testing.assert_array_equal(occupied_voxels(points, side), wanted)


def test_voxels_far_away_do_not_overflow() -> None:
    cells = occupied_voxels(np.array([[0.0, 0, 0], [1e12, 0, 0], [-1e12, 5, 0], [0.5, 0.5, 0.5]]), 1.0)
    assert len(set(cells.tolist())) == 3
    assert cells[0] == cells[3]


def test_centers_that_coincide_cannot_be_separated() -> None:
    same = Gaussians(np.zeros((3, 3)), [[1, 0, 0, 0]] * 3, np.ones((3, 3)), [0.5] * 3, np.zeros((3, 1, 3)))
    assert len(merge_gaussians(same, 1)) == 1
    with pytest.raises(ValueError, match="count: expected at most 1 of 3"):
        merge_gaussians(same, 2)
