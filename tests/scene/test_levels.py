"""Levels: what is drawn without copies is what a copy of the level is."""

from __future__ import annotations

import numpy as np
import pytest

from gsvis.render import rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.levels import Levels
from tests.raycast.scenes import scene


@pytest.fixture(scope="module")
def levels() -> Levels:
    union = scene("mixed", n=90)
    first = np.array([0, 0, 1] * (len(union) // 3), np.uint8)
    last = np.array([0, 1, 1] * (len(union) // 3), np.uint8)
    return Levels(union, first, last, ("low", "high"))


@pytest.mark.parametrize("level", [0, 1])
def test_a_level_is_drawn_as_its_copy(levels: Levels, level: int) -> None:
    camera = Cameras.orbit([0, 0, 0], 3.0, 1, width=40, height=30)
    drawn = levels.drawn_level(level)
    assert drawn.shN is levels.union.shN
    copied = rasterize(levels.level(level), camera)
    for name, image in vars(rasterize(drawn, camera)).items():
        np.testing.assert_array_equal(image, getattr(copied, name), err_msg=name)


def test_a_bare_level_has_the_shapes_of_its_copy(levels: Levels) -> None:
    bare = levels.bare_level(1)
    copied = levels.level(1)
    assert bare.sh_degree == 0
    for name in ("means", "quats", "scales", "opacities", "sh0"):
        np.testing.assert_array_equal(getattr(bare, name), getattr(copied, name), err_msg=name)
    assert bare.facts == copied.facts
