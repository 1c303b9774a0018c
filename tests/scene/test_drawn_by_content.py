"""Random numbers of Gaussians follow the Gaussians, whatever their order, unit and frame."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gsvis.scene.drawn_by_content import draw_by_content
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.judging import find_detail
from gsvis.scene.thinned import thin


def some(count: int = 400, *, seed: int = 0) -> Gaussians:
    """Return Gaussians of which a half has one color and opacity."""
    rng = np.random.default_rng(seed)
    colors = rng.normal(size=(count, 1, 3))
    colors[::2] = 0.5
    opacities = rng.uniform(0.2, 1.0, count)
    opacities[::2] = 0.75
    return Gaussians(
        rng.normal(size=(count, 3)), rng.normal(size=(count, 4)), rng.uniform(0.1, 0.2, (count, 3)), opacities, colors
    )


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_order_unit_and_frame_change_no_number(scale: float) -> None:
    g = some()
    rng = np.random.default_rng(1)
    order = rng.permutation(len(g))
    turn = Rotation.random(random_state=2).as_matrix()
    moved = g.transform(turn, scale * np.array([3.0, -2.0, 1.0]), scale)[order]
    same = draw_by_content(moved) == draw_by_content(g)[order]
    assert same[order % 2 == 1].all()
    assert same.mean() > 0.95  # the order decides between equal ones in one shell
    assert np.mean(np.isin(order[thin(moved, 100)[0]], thin(g, 100)[0])) > 0.95
    assert find_detail(moved)[1] == pytest.approx(scale * find_detail(g)[1], rel=0.02)


def test_numbers_are_spread_and_depend_on_the_seed() -> None:
    g = some(4000)
    drawn = draw_by_content(g)
    assert np.abs(np.histogram(drawn, 8, (0.0, 1.0))[0] / len(g) - 0.125).max() < 0.03
    assert abs(np.corrcoef(drawn, draw_by_content(g, 1))[0, 1]) < 0.1
    same = Gaussians(*(np.repeat(each[:1], 1000, axis=0) for each in (g.means, g.quats, g.scales, g.opacities, g.sh0)))
    assert len(np.unique(draw_by_content(same))) == 1000


def test_an_empty_scene_has_no_numbers() -> None:
    assert draw_by_content(some()[:0]).shape == (0,)
