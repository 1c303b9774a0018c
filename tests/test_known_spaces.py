"""What tests remember of scenes is found once for equal scenes, and anew for others."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from gsvis.io import load_scene, save_scene
from gsvis.scene import upright
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.procedural import two_rooms
from tests import known_spaces


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    save_scene(two_rooms(1000).gaussians, tmp_path / "rooms.ply")
    return tmp_path / "rooms.ply"


@pytest.fixture
def found(monkeypatch: pytest.MonkeyPatch) -> list[Gaussians]:
    """The scenes whose space was looked for, in place of looking."""
    searched: list[Gaussians] = []

    def search(g: Gaussians, **options: object) -> NavigableSpace:
        searched.append(g)
        return NavigableSpace.from_box((1, 1, 1), (2, 2, 2), 8)

    monkeypatch.setattr(known_spaces, "_from_scene", search)
    monkeypatch.setattr(known_spaces, "_found", {})
    return searched


def test_a_scene_that_is_read_twice_is_searched_once(scene: Path, found: list[Gaussians]) -> None:
    with known_spaces.remember_spaces():
        first, again = (NavigableSpace.from_scene(load_scene(scene)) for _ in range(2))
    assert first is again
    assert len(found) == 1


def test_other_facts_and_other_options_are_searched_anew(scene: Path, found: list[Gaussians]) -> None:
    g = load_scene(scene)
    other = g.with_facts(replace(g.facts, box=((1, 1, 1), (2, 2, 2))))
    with known_spaces.remember_spaces():
        for each in (g, other):
            NavigableSpace.from_scene(each)
            NavigableSpace.from_scene(each, resolution=32)
    assert len(found) == 4


def test_the_likely_up_axis_is_the_one_that_is_found_anew(scene: Path) -> None:
    def load() -> Gaussians:
        return load_scene(scene).with_facts(replace(load_scene(scene).facts, up=None))

    plain = upright.find_up(load())
    with known_spaces.remember_spaces():
        for _ in range(2):
            found = upright.find_up(load())
            assert (found.up == plain.up).all()
            assert (found.confidence, found.reason) == (plain.confidence, plain.reason)
