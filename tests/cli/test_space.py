"""`gsvis space`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from gsvis.cli import main
from gsvis.io import save_scene
from gsvis.io.sources import load_source
from gsvis.io.voxels import load_voxels
from gsvis.scene.procedural import two_rooms
from tests.scene.places import discs

pytest.importorskip("skimage", reason="needs scikit-image")

Capture = pytest.CaptureFixture[str]


def test_voxels_of_two_rooms_are_free_where_eyes_are(tmp_path: Path, capsys: Capture) -> None:
    out = tmp_path / "new" / "rooms.voxel.json"
    assert main(["space", "builtin:two_rooms", "-o", str(out), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["files"] == [str(out), str(out.with_name("rooms.voxel.bin"))]
    assert said["bytes"] == sum(path.stat().st_size for path in out.parent.iterdir())
    voxels = load_voxels(out)
    space, _ = load_source("builtin:two_rooms", None).navigable()
    assert space is not None
    x, y, z = space.free.shape  # the file has whole blocks of four
    assert said["solid_voxels"] == np.count_nonzero(voxels.solid[:x, :y, :z])
    assert said["navigable_volume"] == space.volume
    assert not voxels.is_solid(space.sample_viewpoints(500, np.random.default_rng(0))).any()
    known = two_rooms().navigable  # in closed form
    assert said["navigable_volume"] == pytest.approx(known.volume, rel=0.03)
    eyes = known.sample_viewpoints(500, np.random.default_rng(0))
    assert voxels.is_solid(eyes).mean() < 0.03  # those on a border between voxels


def test_meshes_of_two_rooms_contain_the_eyes(tmp_path: Path, capsys: Capture) -> None:
    out = tmp_path / "rooms.glb"
    assert main(["space", "builtin:two_rooms", "-o", str(out), "--frame", "scene"]) == 0
    assert "navigable triangles" in capsys.readouterr().out
    read = trimesh.load(out)
    assert isinstance(read, trimesh.Scene)
    assert read.geometry["navigable"].is_watertight
    space = two_rooms().navigable
    inside = space.origin + np.array([np.argwhere(space.free).min(axis=0), np.argwhere(space.free).max(axis=0) + 1]) * (
        space.voxel_size
    )
    assert np.allclose(read.geometry["navigable"].bounds, inside, atol=0.05)  # to less than a voxel


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["-o", "rooms.obj"], "ends in .glb or .voxel.json"),
        (["-o", "a.voxel.json", "--frame", "scene"], "--frame: expected none"),
        (["-o", "a.voxel.json", "--meters-per-unit", "2"], "--meters-per-unit: expected none"),
        (["-o", "a.glb", "--frame", "scene", "--meters-per-unit", "2"], "--meters-per-unit: expected none"),
        (["-o", "a.glb", "--resolution", "1000"], "--resolution: expected 8 to 384"),
        (["-o", "a.glb", "--resolution", "100", "--around", "auto"], "--resolution: expected no"),
        (["-o", "there.glb"], "say --overwrite"),
        (["-o", "half.voxel.json"], "say --overwrite"),
    ],
)
def test_wrong_arguments_are_one_line(
    words: list[str], line: str, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("there.glb", "half.voxel.bin"):
        (tmp_path / name).touch()
    assert main(["space", "builtin:two_rooms", *words]) == 2
    error = capsys.readouterr().err
    assert line in error.replace("\n", " ")
    assert len(list(tmp_path.iterdir())) == 2


def test_a_scene_without_room_for_an_eye_is_one_line(tmp_path: Path, capsys: Capture) -> None:
    fog = discs(np.random.default_rng(0).uniform(0, 1, (8, 3)), (3.0, 3.0, 3.0), 0.9)
    save_scene(fog, tmp_path / "fog.ply")
    assert main(["space", str(tmp_path / "fog.ply"), "-o", str(tmp_path / "a.glb")]) == 2
    assert "no navigable space" in capsys.readouterr().err
    assert not (tmp_path / "a.glb").exists()
