"""Eyes close to what stops light: nearer to a wall than nine of ten, in free air, in none where there is no wall."""

from __future__ import annotations

import numpy as np

from gsvis.scene.close_eyes import draw_close_eyes
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace

UP = np.array([0.0, 0.0, 1.0])


def box_with_ceiling(height: int = 20) -> NavigableSpace:
    """Return free voxels of side 0.5 below a ceiling at z = height / 2."""
    occupied = np.zeros((8, 8, height + 1), bool)
    occupied[:, :, -1] = True
    return NavigableSpace(np.zeros(3), 0.5, ~occupied, UP, occupied)


def ball(center: tuple[float, float, float]) -> Gaussians:
    """Return one opaque Gaussian."""
    return Gaussians([center], [[1.0, 0.0, 0.0, 0.0]], np.full((1, 3), 0.3), [0.99], np.zeros((1, 1, 3)))


def test_they_are_in_the_tenth_of_the_space_that_is_next_to_the_ceiling() -> None:
    space = box_with_ceiling()
    eyes = draw_close_eyes(ball((2.0, 2.0, -9.0)), space, 200, np.random.default_rng(0))
    assert eyes.shape == (200, 3)
    assert space.contains(eyes).all()
    assert eyes[:, 2].min() > 0.85 * 10.0
    assert eyes[:, :2].std(axis=0).min() > 0.9  # everywhere below it: 4 / sqrt(12) = 1.15


def test_the_same_state_gives_the_same_eyes() -> None:
    g, space = ball((2.0, 2.0, -9.0)), box_with_ceiling()
    one, two = (draw_close_eyes(g, space, 9, np.random.default_rng(3)) for _ in "12")
    np.testing.assert_array_equal(one, two)


def test_none_is_inside_something_solid() -> None:
    middle = np.array([2.0, 2.0, 9.8])
    eyes = draw_close_eyes(ball((2.0, 2.0, 9.8)), box_with_ceiling(), 200, np.random.default_rng(0))
    assert np.linalg.norm(eyes - middle, axis=1).min() > 0.3


def test_there_are_none_where_nothing_stops_light() -> None:
    space = NavigableSpace.from_box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    assert draw_close_eyes(ball((0.5, 0.5, 0.5)), space, 5, np.random.default_rng(0)).shape == (0, 3)
