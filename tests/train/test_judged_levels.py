"""Levels that were made for wrong eyes lose much for judge's eyes, and that is said."""

from __future__ import annotations

import numpy as np
import pytest

from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.view_sampling import ViewSampling
from gsvis.train.level_quality import judge_levels
from tests.scene.tilted_platform import right_eyes, tilted_platform, wrong_eyes

SCENE = tilted_platform()
VIEWS = ViewSampling(5, 48, 36, 75.0)
FAR = np.linalg.norm(SCENE.means, axis=1) > 20.0


def levels_with(low: np.ndarray) -> Levels:
    """Return levels of which the lower has some of the Gaussians."""
    order = np.concatenate([np.flatnonzero(low), np.flatnonzero(~low)])
    first = np.repeat(np.array([0, 1], np.uint8), [low.sum(), (~low).sum()])
    return Levels(SCENE[order], first, np.ones(len(first), np.uint8), ("low", "high"))


@pytest.mark.parametrize(("low", "space", "warned"), [(FAR, wrong_eyes(), True), (~FAR, right_eyes(), False)])
def test_a_level_that_lacks_where_people_stand_is_noticed(low: np.ndarray, space: NavigableSpace, warned: bool) -> None:
    levels = levels_with(low)
    (found,) = judge_levels(levels, VIEWS.cameras(levels, space), VIEWS, space)
    assert len(found.judge) == VIEWS.count
    assert (found.warning is not None) == warned


def test_one_level_has_nothing_to_judge() -> None:
    space, g = right_eyes(), SCENE
    assert isinstance(g, Gaussians)
    assert judge_levels(Levels.single(g), VIEWS.cameras(g, space), VIEWS, space) == ()
