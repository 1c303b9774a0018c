"""Views of levels drawn where eyes may be: who trains, who measures and who chooses have nothing in common."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest

from gsvis.scene.kinds import SpaceKind
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.procedural import random_scene
from gsvis.scene.view_sampling import ViewSampling
from gsvis.train.level_views import draw_views


def test_cameras_that_choose_are_many_and_those_that_train_are_small_both_wide() -> None:
    g = random_scene(np.random.default_rng(0), 400)
    space = NavigableSpace.from_box((-3.0, -3.0, -3.0), (3.0, 3.0, 3.0))
    found = draw_views(g, space, ViewSampling(3, 24, 18), 2)
    assert found.choose_by is not None
    assert found.held_out is not None
    assert (len(found.views), len(found.held_out), len(found.choose_by)) == (3, 2, 12)
    sizes = [(c.width, c.height) for c in (found.views.cameras, found.held_out.cameras, found.choose_by)]
    assert sizes == [(16, 12), (24, 18), (24, 18)]
    slopes = [c.width / (2.0 * c.Ks[:, 0, 0]) for c in (found.views.cameras, found.held_out.cameras, found.choose_by)]
    wide = [int(np.isclose(each, np.tan(np.radians(60.0))).sum()) for each in slopes]
    narrow = [int(np.isclose(each, np.tan(np.radians(30.0))).sum()) for each in slopes]
    assert (wide, narrow) == ([1, 0, 10], [2, 2, 2])  # those that look at detail from near are not wide
    eyes = np.concatenate([c.viewpoints for c in (found.views.cameras, found.held_out.cameras, found.choose_by)])
    assert len(np.unique(eyes.round(9), axis=0)) == 17
    again = draw_views(g, space, ViewSampling(3, 24, 18), 0)
    assert again.choose_by is not None
    np.testing.assert_array_equal(again.choose_by.viewmats, found.choose_by.viewmats)


@pytest.mark.parametrize(("kind", "wide"), [("object", 4), ("rooms", 8)])
def test_a_quarter_of_the_cameras_that_train_is_close_by_outside_of_rooms(
    kind: Literal["object", "rooms"], wide: int
) -> None:
    g = random_scene(np.random.default_rng(0), 400)
    occupied = np.zeros((12, 12, 12), bool)
    occupied[0] = True
    up = np.array([0.0, 0.0, 1.0])
    space = NavigableSpace(np.full(3, -3.0), 0.5, ~occupied, up, occupied, kind=SpaceKind(kind, "given"))
    cameras = draw_views(g, space, ViewSampling(16, 24, 18), 0).views.cameras
    narrow = ~np.isclose(cameras.width / (2.0 * cameras.Ks[:, 0, 0]), np.tan(np.radians(60.0)))
    close = cameras.viewpoints[:, 0] < -1.5
    assert (len(cameras), narrow.sum()) == (16, 16 - wide)
    assert (close & narrow).sum() >= 8 - wide
