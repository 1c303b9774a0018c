"""A scene that states where eyes may be keeps it: a converted built-in scene has the eyes of the built-in one."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsvis.cli import main
from gsvis.cli.options import Where
from gsvis.cli.where import find_place
from gsvis.io.sources import load_source
from gsvis.scene.facts import SceneFacts
from gsvis.scene.procedural import OCCLUDER_SCENES, furnished_flat, two_rooms
from gsvis.scene.similarity import Similarity
from gsvis.scene.source import Source
from gsvis.scene.stated import stated_space
from tests.scene.places import apartment

Capture = pytest.CaptureFixture[str]
QUICK = ["--views", "3", "--width", "12", "--height", "9", "--traced-sample", "0"]


@pytest.fixture(autouse=True)
def _small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsvis.io.sources.builtin_scene", lambda name: OCCLUDER_SCENES[name](4000, sh_degree=0))
    monkeypatch.setattr("gsvis.scene.stated._RESOLUTION", 64)
    monkeypatch.setattr("gsvis.cli.analyze.PICTURE", 24)


def said_by(capsys: Capture, *words: object) -> dict[str, Any]:
    capsys.readouterr()
    assert main([*map(str, words), "--json"]) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def test_what_a_builtin_scene_states_of_its_eyes_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """An eye in one room of the flat would shut those behind its doors."""
    flat = furnished_flat(2000, sh_degree=0)
    monkeypatch.setattr("gsvis.io.sources.builtin_scene", lambda name: flat)
    assert flat.gaussians.facts.box is not None
    assert load_source("builtin:flat", None).gaussians.facts == flat.gaussians.facts


@pytest.mark.parametrize("name", OCCLUDER_SCENES)
def test_a_converted_scene_has_the_same_kind_up_and_volume(name: str, tmp_path: Path, capsys: Capture) -> None:
    known = find_place(load_source(f"builtin:{name}", None), Where())
    assert known.space is not None
    assert known.evidence is not None
    assert known.space.volume == pytest.approx(OCCLUDER_SCENES[name](4000).navigable.volume, rel=0.25)
    for suffix in (".ply", ".spz", ".sog", ".ksplat"):
        path = tmp_path / f"x{suffix}"
        assert main(["convert", f"builtin:{name}", str(path)]) == 0
        place = find_place(load_source(str(path), None), Where())
        assert place.space is not None
        assert place.space.kind == known.space.kind
        assert place.evidence == known.evidence
        assert place.doubt == known.doubt == ""
        assert np.allclose(place.space.up, known.space.up)
        assert place.space.volume == pytest.approx(known.space.volume, rel=0.01)


def test_a_converted_scene_gives_the_same_figures(tmp_path: Path, capsys: Capture) -> None:
    path = tmp_path / "rooms.ply"
    assert main(["convert", "builtin:two_rooms", str(path)]) == 0
    voxels = ["-o", tmp_path / "a.voxel.json", "--overwrite"]
    first, second = (said_by(capsys, "space", scene, *voxels) for scene in ("builtin:two_rooms", path))
    assert first | {"in": ""} == second | {"in": ""}
    report = ["-o", tmp_path / "report", *QUICK]
    first, second = (said_by(capsys, "analyze", scene, *report) for scene in ("builtin:two_rooms", path))
    assert first["scene"]["space"] == second["scene"]["space"]
    for figures in ("visible_fraction", "directions"):
        assert first[figures] == second[figures]


def test_a_moved_scene_keeps_its_box() -> None:
    made = load_source("builtin:two_rooms", None).gaussians
    here = stated_space(made)
    assert here is not None
    eyes = here.sample_viewpoints(500, np.random.default_rng(0))
    for scale, degrees in ((1e-3, 25.0), (1e3, 90.0)):
        turn = np.radians(degrees)
        rotation = np.array([[1, 0, 0], [0, np.cos(turn), -np.sin(turn)], [0, np.sin(turn), np.cos(turn)]])
        shift = scale * np.array([3.0, -1.0, 2.0])
        there = stated_space(made.transform(rotation, shift, scale))
        assert there is not None
        assert there.volume / scale**3 == pytest.approx(here.volume, rel=0.01)
        assert np.allclose(there.up, rotation @ here.up)
        assert there.contains(Similarity.from_rotation(scale, rotation, shift).apply(eyes)).mean() > 0.95


def test_the_box_of_a_file_is_evidence_and_a_box_by_hand_comes_before() -> None:
    source = load_source("builtin:two_rooms", None)
    stated = find_place(source, Where())
    by_hand = find_place(source, Where(box=(0.5, 0.5, 0.5, 3.5, 3.5, 2.5)))
    assert stated.evidence is not None
    assert by_hand.evidence is not None
    assert (stated.evidence.source, stated.evidence.text) == ("box", "a box that the scene states")
    assert (by_hand.evidence.source, by_hand.evidence.text) == ("box", "a box given by hand")


def test_a_box_without_room_is_said_and_the_scene_decides() -> None:
    g = apartment()
    wall = SceneFacts(up=(0.0, 0.0, 1.0), box=((-0.01, 0.0, 0.0), (0.01, 0.5, 0.5)))
    assert find_place(Source("a", g), Where()).remarks == []
    place = find_place(Source("a", g.with_facts(wall)), Where())
    assert place.space is not None
    assert place.space.kind.kind == "rooms"
    assert any("box that the scene states" in each for each in place.remarks)


def test_parts_that_no_eye_reaches_do_not_count() -> None:
    g = two_rooms(4000, sh_degree=0).gaussians
    box = SceneFacts(up=(0.0, 0.0, 1.0), box=((0.3, 0.3, 0.3), (10.0, 3.7, 2.7)))
    whole, inside = (stated_space(g.with_facts(replace(box, eye=eye))) for eye in (None, (0.8, 2.0, 1.6)))
    assert whole is not None
    assert inside is not None
    outside = np.array([[9.0, 2.0, 1.5]])  # behind the last wall, and still in the box
    assert whole.contains(outside).all()
    assert not inside.contains(outside).any()
