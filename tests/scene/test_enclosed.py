"""Eyes within walls: found in rooms, of whatever scale and however turned, and no matter where there are none."""

from __future__ import annotations

import numpy as np
import pytest

from gsvis.scene._enclosed import LEAST, Enclosure
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.judging import draw_judges
from tests.scene.places import apartment, ball, discs, sheet
from tests.scene.test_judging import look_at


def furnished() -> Gaussians:
    """Return one room, 4 x 3 x 2.5, whose walls hold few Gaussians and which holds two balls of many."""
    walls = [
        sheet(axis, at, low, high, 0.25)
        for axis, low, high, ends in (
            (0, (0.0, 0.0), (3.0, 2.5), (0.0, 4.0)),
            (1, (0.0, 0.0), (4.0, 2.5), (0.0, 3.0)),
            (2, (0.0, 0.0), (4.0, 3.0), (0.0, 2.5)),
        )
        for at in ends
    ]
    return Gaussians.concatenate([*walls, ball((1.0, 1.0, 0.8), 0.3, 2000), ball((3.0, 2.0, 0.6), 0.3, 2000)])


def inside(points: np.ndarray) -> np.ndarray:
    """Return which points lie in that room."""
    return np.all((points > 0.0) & (points < [4.0, 3.0, 2.5]), axis=1)


def enclosure_of(g: Gaussians, turn: np.ndarray) -> Enclosure:
    """Return what tells of a room that was turned, with axes that turned with it."""
    return Enclosure(look_at(g), g.means[-4000:].astype(np.float64), 1.5, turn.T)


WITHIN = np.array([[0.5, 2.0, 1.0], [2.0, 1.5, 1.2], [3.5, 0.6, 1.0], [2.2, 2.6, 0.6], [1.8, 0.5, 1.9]])
BEHIND = np.array([[-0.8, 1.0, 1.0], [5.0, 2.0, 1.0], [2.0, -0.6, 1.0], [2.0, 1.5, 3.2], [1.0, 1.0, -0.9]])
EYES = np.concatenate([WITHIN, BEHIND])


def test_eyes_behind_walls_are_told_from_those_within() -> None:
    g = furnished()
    enclosure = enclosure_of(g, np.eye(3))
    assert enclosure.holds(EYES).tolist() == inside(EYES).tolist()
    chosen = enclosure.choose(EYES)
    assert chosen is not None
    assert chosen.tolist() == inside(EYES).tolist()


def test_what_is_found_turns_with_the_scene() -> None:
    turn, _ = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    moved = furnished().transform(rotation=turn)
    assert enclosure_of(moved, turn).holds(EYES @ turn.T).tolist() == inside(EYES).tolist()


def test_too_few_eyes_and_eyes_of_one_kind_say_nothing() -> None:
    enclosure = enclosure_of(furnished(), np.eye(3))
    assert enclosure.choose(EYES[: LEAST - 1]) is None
    assert enclosure.choose(np.repeat(EYES[:1], LEAST, axis=0)) is None
    assert enclosure.choose(np.repeat(EYES[-1:], LEAST, axis=0)) is None


def test_an_object_that_is_seen_from_outside_as_well_rejects_no_eye() -> None:
    shell = ball((0, 0, 0), 1.0, 4000)
    within = np.random.default_rng(0).normal(scale=0.1, size=(5, 3))
    around = np.random.default_rng(1).normal(size=(20, 3))
    around *= 2.0 / np.linalg.norm(around, axis=1, keepdims=True)
    enclosure = Enclosure(look_at(shell), shell.means.astype(np.float64), 1.0, np.eye(3))
    assert enclosure.holds(within).all()
    assert enclosure.choose(np.concatenate([within, around])) is None


def test_judges_of_rooms_stand_in_them() -> None:
    g = furnished()
    found = draw_judges(g, 24, look_at(g)).viewpoints
    assert len(found) == 24
    assert inside(found).mean() >= 0.9


@pytest.mark.parametrize("seed", [0, 1])
def test_judges_of_what_is_seen_from_around_stand_around(seed: int) -> None:
    rng = np.random.default_rng(seed)
    g = discs(rng.uniform([-1, -1, 0], [1, 1, 0.2], (3000, 3)), (0.05, 0.05, 0.05))
    assert len(draw_judges(g, 16, look_at(g), seed=seed)) == 16


def test_judges_of_an_apartment_stand_in_it() -> None:
    g = apartment()
    found = draw_judges(g, 24, look_at(g)).viewpoints
    low, high = g.means.min(axis=0), g.means.max(axis=0)
    assert np.all((found > low) & (found < high), axis=1).mean() >= 0.9
