"""Where eyes are if somebody says what the scene is: nothing is weighed, and a turn of the scene changes nothing."""

from __future__ import annotations

import numpy as np
import pytest

from gsvis.scene.navigable import NavigableSpace
from tests.scene.places import apartment, island, statue

TURN = np.array([[0.8, -0.6, 0.0], [0.36, 0.48, -0.8], [0.48, 0.64, 0.6]])  # (45, 0, 20) is no rounder


def of_kind(g, kind, up="+z") -> NavigableSpace:  # type: ignore[no-untyped-def]
    return NavigableSpace.of_kind(g, kind, resolution=48, up=up)


def test_an_object_is_looked_at_from_around() -> None:
    g = statue()
    space = of_kind(g, "object")
    eyes = space.sample_viewpoints(200, np.random.default_rng(0))
    inside = np.all((eyes > g.means.min(axis=0)) & (eyes < g.means.max(axis=0)), axis=1)
    assert not inside.any()
    assert (space.kind.kind, space.kind.sure, space.kind.other) == ("object", True, None)


def test_rooms_are_seen_from_inside() -> None:
    g = apartment()
    eyes = of_kind(g, "rooms").sample_viewpoints(200, np.random.default_rng(0))
    assert np.all((eyes > g.means.min(axis=0) - 0.1) & (eyes < g.means.max(axis=0) + 0.1))


def test_in_an_open_place_eyes_are_above_its_ground() -> None:
    space = of_kind(island(), "open place")
    eyes = space.sample_viewpoints(200, np.random.default_rng(0))
    assert np.all(eyes[:, 2] > 0.0)
    assert np.all(np.linalg.norm(eyes[:, :2], axis=1) < 4.0)


@pytest.mark.parametrize("kind", ["object", "rooms", "open place"])
def test_a_turn_of_the_scene_turns_the_eyes(kind: str) -> None:
    g = {"object": statue, "rooms": apartment, "open place": island}[kind]()
    plain, turned = of_kind(g, kind), of_kind(g.transform(TURN, (3.0, -2.0, 1.0)), kind, TURN[:, 2])
    assert turned.volume == pytest.approx(plain.volume, rel=0.15)
    eyes = plain.sample_viewpoints(400, np.random.default_rng(0))
    assert turned.contains(eyes @ TURN.T + (3.0, -2.0, 1.0)).mean() > 0.85


def test_only_the_kinds_that_there_are() -> None:
    with pytest.raises(ValueError, match=r"^kind: expected one of object, rooms, open place, got 'given'"):
        of_kind(statue(), "given")
