"""A scene in other units, or a million units away, gets the same answers; benchmarks/same_anywhere.py asks more."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gsvis.cli import main
from gsvis.io import save_scene
from gsvis.io.sources import load_source
from gsvis.scene.inspection import inspect_scene
from gsvis.scene.procedural import OCCLUDER_SCENES

Capture = pytest.CaptureFixture[str]


def test_space_is_the_same_in_other_units_and_far_away(
    tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gsvis.io.sources.builtin_scene", lambda name: OCCLUDER_SCENES[name](2000, sh_degree=0))
    monkeypatch.setattr("gsvis.scene.stated._RESOLUTION", 64)
    g = load_source("builtin:two_rooms", None).gaussians
    far = g.with_facts(replace(g.facts, origin=(1e6, 1e6, 1e6)))
    found = []
    scenes = {1.0: g, 1e-3: g.transform(np.eye(3), scale=1e-3), 1e3: g.transform(np.eye(3), scale=1e3), 1.5: far}
    for name, scene in scenes.items():
        save_scene(scene, tmp_path / f"{name}.ply")
        words = ["space", str(tmp_path / f"{name}.ply"), "-o", str(tmp_path / "a.voxel.json"), "--overwrite", "--json"]
        assert main(words) == 0
        said = json.loads(capsys.readouterr().out)
        scale = 1.0 if scene is far else name
        found.append((said["kind"]["kind"], said["navigable_volume"] / scale**3, said["solid_voxels"]))
    for kind, volume, solid in found[1:]:
        assert kind == found[0][0]
        assert volume == pytest.approx(found[0][1], rel=0.01)
        assert solid == pytest.approx(found[0][2], rel=0.01)


def test_an_inspection_does_not_depend_on_the_turn() -> None:
    g = OCCLUDER_SCENES["two_rooms"](2000, sh_degree=0).gaussians
    turn = np.radians(25.0)
    rotation = np.array([[np.cos(turn), -np.sin(turn), 0.0], [np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]])
    here, there = inspect_scene(g, up="+z"), inspect_scene(g.transform(rotation), up="+z")
    assert there.floaters == here.floaters
    for name in ("farthest", "giant_share", "needle_share", "disc_share", "opaque_share"):
        assert getattr(there, name) == pytest.approx(getattr(here, name), rel=0.01, abs=1e-3)
