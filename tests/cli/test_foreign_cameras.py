"""Cameras of another frame: every command that takes cameras has --cameras-frame, and reports those that do not fit."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from gsvis.cli import main
from gsvis.cli.arguments import Command
from gsvis.cli.options import command_name, leaves
from gsvis.io import save_scene
from gsvis.scene.procedural import two_rooms

COMMANDS = {
    "space": "space {ply} -o {out}.glb --cameras {cameras}",
    "paint": "paint {ply} -o {out}.ply --cameras {cameras} --face-size 16 --eyes 1",
    "render": "render {ply} -o {out}/ --cameras {cameras} --width 16 --height 12",
}

WITH_CAMERAS = {
    "inspect": "inspect {ply}",
    "analyze": "analyze {ply} -o {out}",
    "render": "render {ply} -o {out}/",
    "pvs": "pvs {ply} -o {out}.pvs",
    "pvs-report": "pvs-report {pvs} {ply} -o {out}",
    "color": "color {ply} -o {out}.arrow",
    "levels": "levels {ply} -o {out}",
    "clean": "clean {ply} -o {out}.ply",
    "cut": "cut {ply} -o {out}.ply",
    "paint": "paint {ply} -o {out}.ply",
    "prepare": "prepare {ply} -o {out}.gsvis",
    "export": "export {ply} -o {out}",
    "space": "space {ply} -o {out}.glb",
    "world": "world {ply} -o {out}.gsworld",
    "view": "view {ply} --no-browser",
}
"""Every command that takes cameras."""


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A scene, and eight cameras outside of it that look away; the scene is far smaller than their frame."""
    folder = tmp_path_factory.mktemp("foreign")
    save_scene(two_rooms(1000, sh_degree=0).gaussians, folder / "rooms.ply")
    frames = []
    for k in range(8):
        matrix = np.eye(4)
        matrix[:3, 3] = 300.0 + 10.0 * k, 300.0, -300.0 - 10.0 * k
        frames.append({"file_path": f"{k}.png", "transform_matrix": matrix.tolist()})
    cameras = {"w": 64, "h": 48, "fl_x": 60.0, "fl_y": 60.0, "cx": 32.0, "cy": 24.0, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(cameras))
    pvs = "pvs {0}/rooms.ply -o {0}/rooms.pvs --cells 1 --face-size 16 --certify 64 --max-inner 1 --workers 1 {1}"
    assert main(pvs.format(folder, "--box 1 1 1 2 2 2").split()) == 0
    return {"ply": folder / "rooms.ply", "pvs": folder / "rooms.pvs", "cameras": folder / "transforms.json"}


@pytest.mark.parametrize("name", COMMANDS)
def test_json_says_that_cameras_are_of_another_frame(
    name: str, places: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [word.format(**places, out=tmp_path / "a") for word in COMMANDS[name].split()]
    assert main([*words, "--json"]) == 0
    said = " ".join(_texts(json.loads(capsys.readouterr().out)))
    assert "of 8 cameras see nothing of the scene" in said


def _texts(value: object) -> list[str]:
    if isinstance(value, dict):
        return [text for inner in value.values() for text in _texts(inner)]
    if isinstance(value, list):
        return [text for inner in value for text in _texts(inner)]
    return [value] if isinstance(value, str) else []


def test_every_command_that_takes_cameras_takes_their_frame() -> None:
    takes = {command_name(kind): {leaf.name for leaf in leaves(kind)} for kind in get_args(Command)}
    with_cameras = {name for name, names in takes.items() if "cameras" in names}
    assert with_cameras == {name for name, names in takes.items() if "cameras_frame" in names}
    assert with_cameras == set(WITH_CAMERAS)


@pytest.mark.parametrize("name", WITH_CAMERAS)
def test_the_frame_is_obeyed(
    name: str, places: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """No file beside these cameras says how they are moved."""
    words = [word.format(**places, out=tmp_path / "a") for word in WITH_CAMERAS[name].split()]
    assert main([*words, "--cameras-frame", "capture"]) == 2
    assert re.search("--cameras-frame: expected --cameras with it|say where the eyes are", capsys.readouterr().err)
    assert main([*words, "--cameras", str(places["cameras"]), "--cameras-frame", "capture"]) == 2
    assert "--cameras-frame: expected a dataparser_transforms.json" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
