"""Positions given for a scene with an origin are taken in either of its two frames."""

from __future__ import annotations

import numpy as np
import pytest

from gsvis.scene.facts import SceneFacts
from gsvis.scene.paths import HeadPath
from gsvis.scene.procedural import random_scene
from gsvis.scene.source_frame import SourceFrame

ORIGIN = (4e5, -2e6, 100.5)


@pytest.fixture(scope="module")
def frame() -> SourceFrame:
    g = random_scene(np.random.default_rng(1), 200)
    return SourceFrame.from_scene(g.with_facts(SceneFacts(origin=ORIGIN)))


def test_positions_are_found_in_both_frames(frame: SourceFrame) -> None:
    here = np.random.default_rng(2).uniform(-3.0, 3.0, (20, 3))
    assert np.array_equal(frame.points(here), here)
    assert np.array_equal(frame.points(here + ORIGIN), here + ORIGIN - np.array(ORIGIN))
    assert np.abs(frame.points(here + ORIGIN) - here).max() < 1e-9


def test_outliers_do_not_decide(frame: SourceFrame) -> None:
    here = np.zeros((5, 3))
    here[0] = 1e9
    assert np.array_equal(frame.points(here), here)


def test_a_scene_without_an_origin_has_one_frame() -> None:
    plain = SourceFrame.from_scene(random_scene(np.random.default_rng(1), 200))
    far = np.full((3, 3), 1e7)
    assert np.array_equal(plain.points(far), far)


def test_a_walk_keeps_its_times_and_turns(frame: SourceFrame) -> None:
    here = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    walk = HeadPath(np.array([0.0, 1.0]), here + ORIGIN, np.array([[1.0, 0, 0, 0], [0, 1.0, 0, 0]]))
    found = frame.walk(walk)
    assert np.array_equal(found.positions, here)
    assert np.array_equal(found.times, walk.times)
    assert np.array_equal(found.quats, walk.quats)


def test_no_positions_stay_none(frame: SourceFrame) -> None:
    assert frame.points(np.zeros((0, 3))).shape == (0, 3)
    with pytest.raises(ValueError, match="points"):
        frame.points(np.zeros((2, 2)))
