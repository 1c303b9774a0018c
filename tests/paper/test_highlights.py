"""The place of figure 17: it is where the color changes, and eyes see it."""

from __future__ import annotations

import numpy as np
import pytest
from paper.highlights import find_highlight

from gsvis.color import sh_colors
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace


def three_in_a_row(shiny: int) -> Gaussians:
    """Return three small Gaussians of which one changes its color along x."""
    higher = np.zeros((3, 3, 3), np.float32)
    higher[shiny, 2] = 0.5
    return Gaussians(
        means=np.array([[-0.5, 0, 0], [0, 0, 0], [0.5, 0, 0]], np.float32),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (3, 1)),
        scales=np.full((3, 3), 0.05, np.float32),
        opacities=np.full(3, 0.9, np.float32),
        sh0=np.zeros((3, 1, 3), np.float32),
        shN=higher,
    )


@pytest.mark.parametrize("shiny", [0, 2])
def test_the_place_is_where_the_color_changes(shiny: int) -> None:
    scene = three_in_a_row(shiny)
    space = NavigableSpace.from_box([-2, 0.5, -2], [2, 2, 2], 16, up=[0, 0, 1])
    found = find_highlight(scene, space, np.ones(3))
    assert np.allclose(found.target, scene.means[shiny])
    first, _, last = (sh_colors(scene, eye)[shiny] for eye in found.eyes)
    assert np.abs(first - last).max() > 0.2
    assert found.angles[0] == pytest.approx(0.0, abs=1e-3)
    assert found.angles[2] > 45.0
    assert len(found.cameras(8, 6)) == 3


def test_a_scene_that_no_two_eyes_see_is_refused() -> None:
    scene = three_in_a_row(0)
    space = NavigableSpace.from_box([-2, 0.5, -2], [2, 2, 2], 16, up=[0, 0, 1])
    faint = Gaussians(
        scene.means, scene.quats, scene.scales, np.full(3, 1e-4, np.float32), scene.sh0, scene.shN
    )  # fmt: skip
    with pytest.raises(ValueError, match="take another scene"):
        find_highlight(faint, space, np.ones(3))
