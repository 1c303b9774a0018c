"""The guard gives back what held-out views need, and only that."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gsvis.edit import Shape, class_of, guard, held_out_cameras, measure_cost
from gsvis.scene.cameras import Cameras
from tests.edit.worlds import QUICK, Dirty, dirty_room


@pytest.fixture(scope="module")
def dirty() -> Dirty:
    return dirty_room()


@pytest.fixture(scope="module")
def cameras(dirty: Dirty) -> Cameras:
    return held_out_cameras(dirty.scene, Shape.from_scene(dirty.scene), dirty.space, 3, 5)


def test_what_a_view_sees_is_no_longer_unseen(dirty: Dirty, cameras: Cameras) -> None:
    wrong = dirty.classes.copy()
    wrong[: int(np.count_nonzero(dirty.classes == 0))] = class_of("unseen")  # the whole room
    right, costs = guard(dirty.scene, wrong, cameras, QUICK)
    assert costs["unseen"].back > 0
    assert measure_cost(dirty.scene, right == 0, cameras).worst_db < 100.0
    hidden = np.isin(right, [class_of(name) for name in ("unseen", "interior", "flyaways")])
    assert measure_cost(dirty.scene, ~hidden, cameras).worst_db >= QUICK.least_db
    assert np.array_equal(wrong != 0, (dirty.classes != 0) | (wrong == class_of("unseen")))  # not changed


def test_a_wall_taken_for_floaters_is_given_back(dirty: Dirty, cameras: Cameras) -> None:
    wrong = dirty.classes.copy()
    wrong[dirty.scene.means[:, 2] < 0.2] = class_of("floaters")  # the floor
    right, costs = guard(dirty.scene, wrong, cameras, QUICK)
    assert costs["floaters"].changed > QUICK.most_changed
    assert costs["floaters"].back == int(np.count_nonzero(wrong == class_of("floaters")))
    assert not (right == class_of("floaters")).any()
    assert (right == class_of("fog")).any()
    allowed, _ = guard(dirty.scene, wrong, cameras, replace(QUICK, most_changed=1.0))
    assert np.array_equal(allowed == class_of("floaters"), wrong == class_of("floaters"))


def test_nothing_costs_nothing(dirty: Dirty, cameras: Cameras) -> None:
    right, costs = guard(dirty.scene, np.zeros(len(dirty.scene), np.uint8), cameras, QUICK)
    assert not right.any()
    assert (costs["all"].worst_db, costs["all"].changed, costs["all"].light_lost) == (100.0, 0.0, 0.0)
