"""Districts: what is rounded for the stream stays what it is for the eye."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from gsvis.scene.gaussians import Gaussians
from gsvis.scene.sh import SH_C0
from gsvis.world.districts import round_colors, round_shapes


def random_scene(seed: int, count: int = 200) -> Gaussians:
    rng = np.random.default_rng(seed)
    return Gaussians(
        rng.normal(size=(count, 3)), rng.normal(size=(count, 4)), np.exp(rng.normal(size=(count, 3))),
        rng.random(count), rng.normal(size=(count, 1, 3)),
    )  # fmt: skip


@given(st.integers(0, 1 << 30))
def test_rounded_shapes_are_near_to_what_they_were(seed: int) -> None:
    g = random_scene(seed)
    found = round_shapes(g)
    for name in ("means", "opacities", "sh0"):
        np.testing.assert_array_equal(getattr(found, name), getattr(g, name))
    assert np.abs(np.log2(found.scales / g.scales)).max() <= 0.1251
    turns = 2.0 * np.degrees(np.arccos(np.minimum(np.abs(np.einsum("ij,ij->i", found.quats, g.quats)), 1.0)))
    assert turns.max() < 9.0
    assert np.median(turns) < 4.0


def test_few_values_are_left() -> None:
    found = round_shapes(random_scene(3, 5000))
    smaller = np.sort(np.abs(found.quats), axis=1)[:, :3]
    assert len(np.unique(np.round(smaller, 4))) <= 100
    assert len(np.unique(found.scales)) <= 50


def test_an_axis_of_a_quaternion_may_be_exact() -> None:
    one = Gaussians([[0, 0, 0]], [[0, -1, 0, 0]], [[1, 2, 4]], [0.5], np.zeros((1, 1, 3)))
    np.testing.assert_allclose(np.abs(round_shapes(one).quats), [[0, 1, 0, 0]], atol=1e-7)


def test_rounded_colors_are_few_and_near() -> None:
    g, reach = random_scene(5, 3000), ((0.0, 1.0), (0.1, 1.3), (0.4, 0.4))
    before, after = (np.maximum(0.5 + SH_C0 * each.sh0[:, 0], 0.0) for each in (g, round_colors(g, reach)))
    for k, (low, high) in enumerate(reach[:2]):
        within = (before[:, k] >= low) & (before[:, k] <= high)
        assert np.abs(after - before)[within, k].max() <= 3.01 * (high - low) / 255
        assert len(np.unique(np.round(after[:, k], 5))) <= 64
    np.testing.assert_allclose(after[:, 2], 0.4, atol=1e-6)
