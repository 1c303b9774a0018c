"""Places of a scene with an origin are given in the coordinates of its file, or relative to the origin."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from gsvis.cli import main
from gsvis.io import load_scene, save_scene
from gsvis.io.poses import write_poses
from gsvis.scene.facts import SceneFacts
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.paths import HeadPath
from gsvis.scene.procedural import two_rooms

ORIGIN = np.array([4e5, -2e6, 128.0])
Run = Callable[..., str]


@pytest.fixture(scope="module")
def scene() -> Gaussians:
    g = two_rooms(2000, sh_degree=0).gaussians
    x, y, z = ORIGIN.tolist()
    return g.with_facts(SceneFacts(origin=(x, y, z), up=(0.0, 0.0, 1.0), up_source="a test"))


@pytest.fixture
def file(scene: Gaussians, tmp_path: Path) -> Path:
    save_scene(scene, tmp_path / "far.ply")
    return tmp_path / "far.ply"


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    def run(*words: str) -> str:
        assert main(list(words)) == 0, capsys.readouterr().err
        return capsys.readouterr().out

    return run


def middle(g: Gaussians) -> np.ndarray:
    return np.asarray(g.bounds(0.9).mean(axis=0) - [1.5, 0.0, 0.0])


def spelled(point: np.ndarray) -> list[str]:
    return [f"{value:.6f}" for value in point]


@pytest.mark.parametrize("shift", [np.zeros(3), ORIGIN])
def test_a_box_and_a_center_are_taken_in_both_frames(file: Path, scene: Gaussians, run: Run, shift: np.ndarray) -> None:
    low, high = middle(scene) - 0.5 + shift, middle(scene) + 0.5 + shift
    box = json.loads(run("inspect", str(file), "--json", "--box", *spelled(low), *spelled(high)))
    assert box["space"]["kind"]["kind"] == "given"
    assert not any("--box" in problem for problem in box["problems"])
    around = json.loads(run("inspect", str(file), "--json", "--around", *spelled(middle(scene) + shift), "0.5"))
    assert around["space"]["kind"]["kind"] == "given"


@pytest.mark.parametrize("shift", [np.zeros(3), ORIGIN])
def test_a_walk_and_an_eye_are_taken_in_both_frames(
    file: Path, scene: Gaussians, run: Run, tmp_path: Path, shift: np.ndarray
) -> None:
    times = np.arange(8) / 4
    along = middle(scene) + np.linspace(-0.3, 0.3, 8)[:, None] * [1.0, 0.0, 0.0]
    write_poses(HeadPath(times, along + shift, np.tile([1.0, 0.0, 0.0, 0.0], (8, 1))), tmp_path / "walk.csv")
    found = json.loads(run("inspect", str(file), "--json", "--path", str(tmp_path / "walk.csv")))
    assert found["space"] is not None
    images = []
    for near in (np.zeros(3), shift):
        eye = middle(scene) + near
        target = eye + np.array([1.0, 0.0, 0.0])
        place = ["--eye", *spelled(eye), "--target", *spelled(target), "--width", "24", "--height", "16"]
        run("render", str(file), "-o", str(tmp_path / "view.png"), "--overwrite", *place)
        images.append((tmp_path / "view.png").read_bytes())
    assert images[0] == images[1]


def test_a_space_says_what_it_is_relative_to(file: Path, run: Run, tmp_path: Path) -> None:
    said = json.loads(run("space", str(file), "-o", str(tmp_path / "s.voxel.json"), "--json"))
    assert said["origin"] == ORIGIN.tolist()
    assert load_scene(file).facts.origin == tuple(ORIGIN)
