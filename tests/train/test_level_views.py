"""Views of levels drawn where eyes may be: who trains, who measures and who chooses have nothing in common."""

from __future__ import annotations

import numpy as np

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
