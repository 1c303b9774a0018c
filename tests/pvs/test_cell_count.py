"""How many cells a space gets: fewer around an object or in a place that is seen from anywhere, never in rooms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gsvis.pvs.cell_count import fitting_cells
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.kinds import SpaceKind
from gsvis.scene.navigable import NavigableSpace

OBJECT = SpaceKind("object", "made for a test")
PLACE = SpaceKind("open place", "made for a test")
FEWER = {"object": 64, "open place": 80}


def space_around(kind: SpaceKind) -> NavigableSpace:
    return replace(NavigableSpace.from_box((3.0, -2.0, -2.0), (5.0, 2.0, 2.0), 8), kind=kind)


def ball(opacity: float, count: int = 600) -> Gaussians:
    rng = np.random.default_rng(0)
    means = rng.normal(size=(count, 3))
    means *= rng.uniform(0.0, 1.0, (count, 1)) ** (1 / 3) / np.linalg.norm(means, axis=1, keepdims=True)
    return Gaussians(means, [[1, 0, 0, 0]] * count, [[0.15] * 3] * count, [opacity] * count, np.zeros((count, 1, 3)))


@pytest.mark.parametrize(("most", "fewer"), [(4, 1), (128, 64), (512, 128)])
def test_an_object_that_is_seen_through_has_fewer_cells(most: int, fewer: int) -> None:
    assert fitting_cells(ball(0.05), space_around(OBJECT), most, {"object": fewer}) == fewer


def test_an_object_that_hides_most_of_itself_keeps_all_cells() -> None:
    assert fitting_cells(ball(0.99, 5000), space_around(OBJECT), 256, FEWER) == 256


def test_an_open_place_that_is_seen_through_has_fewer_cells() -> None:
    assert fitting_cells(ball(0.05), space_around(PLACE), 256, FEWER) == 80


def test_an_open_place_that_hides_most_of_itself_keeps_all_cells() -> None:
    assert fitting_cells(ball(0.99, 5000), space_around(PLACE), 256, FEWER) == 256


@pytest.mark.parametrize("kind", [SpaceKind("rooms", "made for a test"), SpaceKind("given", "made for a test")])
def test_other_spaces_keep_all_cells(kind: SpaceKind) -> None:
    assert fitting_cells(ball(0.05), space_around(kind), 256, FEWER) == 256


def test_few_cells_stay_and_none_is_refused() -> None:
    assert fitting_cells(ball(0.05), space_around(OBJECT), 3, FEWER) == 3
    with pytest.raises(ValueError, match="most"):
        fitting_cells(ball(0.05), space_around(OBJECT), 0, FEWER)
    with pytest.raises(ValueError, match="fewer, object"):
        fitting_cells(ball(0.05), space_around(OBJECT), 3, {"object": 0})


def test_a_scene_of_nothing_has_all_cells() -> None:
    assert fitting_cells(ball(0.001), space_around(OBJECT), 256, FEWER) == 256
