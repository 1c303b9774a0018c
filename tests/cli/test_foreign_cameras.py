"""Cameras of another frame: a command that prints JSON says it there, as its lines for people do."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from gsvis.cli import main
from gsvis.io import save_scene
from gsvis.scene.procedural import two_rooms

COMMANDS = {
    "space": "space {ply} -o {out}.glb --cameras {cameras}",
    "paint": "paint {ply} -o {out}.ply --cameras {cameras} --face-size 16 --eyes 1",
    "render": "render {ply} -o {out}/ --cameras {cameras} --width 16 --height 12",
}


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
    return {"ply": folder / "rooms.ply", "cameras": folder / "transforms.json"}


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
