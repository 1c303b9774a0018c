"""`gsvis world` and `gsvis verify` on worlds: from a scene to a whole world, and one line for what is wrong."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from gsvis.cli import main
from gsvis.package.made_from import candidates_of, made_from_of
from gsvis.world import World
from tests import warm_start
from tests.few_views import take_few_views
from tests.world import cities

SMALL = ["--levels", "none", "--tile", "2500", "--cells", "1", "--face-size", "24", "--limit", "0.05", "--workers", "1"]


@pytest.fixture(scope="module", autouse=True)
def few_views() -> Iterator[None]:
    with take_few_views():
        yield


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> str:
    return cities.write(cities.street(), tmp_path_factory.mktemp("scene") / "street.ply")[0]


def test_a_scene_becomes_a_world_that_is_whole(scene: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    out = str(tmp_path / "city.gsworld")
    assert main(["world", scene, "-o", out, *SMALL, "--dry-run", "--json"]) == 0
    expected = json.loads(capfd.readouterr().out)
    assert not list(tmp_path.iterdir())
    assert main(["world", scene, "-o", out, *SMALL, "--json"]) == 0
    made = json.loads(capfd.readouterr().out)
    assert made["gaussians"] == expected["gaussians"] == len(cities.street())
    assert made["tiles"] >= expected["tiles"] >= 1
    assert main(["verify", out, "--json"]) == 0
    found = json.loads(capfd.readouterr().out)
    assert found["tiles"] == made["tiles"]
    assert found["cells"] == made["cells"] > 0
    named = made_from_of(World.open(out).manifest.provenance)
    assert [(each.name, each.path) for each in named] == [("street.ply", None)]
    assert candidates_of(named, out) == [[Path(scene)]]
    assert main(["verify", out]) == 0
    assert "Every part is whole." in capfd.readouterr().out
    assert main(["world", scene, "-o", out, *SMALL, "--discard"]) == 0
    assert "tiles" in capfd.readouterr().out
    assert [path.name for path in tmp_path.iterdir()] == ["city.gsworld"]


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--scheduler", "10.0.0.5"], "expected an address such as tcp://10.0.0.5:8786"),
        (["--scheduler", "tcp://127.0.0.1:1", "--workers", "2"], "--workers: expected none with --scheduler, got 2"),
        (["--lod", "1"], "--lod: expected one number, or one for each streamed scene, which are 0"),
        (["--up", "north"], "north"),
        (["--levels", "0.5", "0.3"], "--levels: expected each below the next"),
        (["--margin", "2"], "--margin: expected --path with it"),
    ],
)
def test_wrong_arguments_end_with_one_line(
    scene: str, tmp_path: Path, capfd: pytest.CaptureFixture[str], more: list[str], message: str
) -> None:
    assert main(["world", scene, "-o", str(tmp_path / "c.gsworld"), *more]) == 2
    error = capfd.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_a_world_has_eyes_along_a_path_alone(scene: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    walk, out = tmp_path / "walk.csv", tmp_path / "c.gsworld"
    walk.write_text("t,x,y,z,qw,qx,qy,qz\n0,0.5,2,1.5,1,0,0,0\n4,4,2,1.5,1,0,0,0\n")
    assert main(["world", scene, "-o", str(out), *SMALL, "--path", str(walk), "--margin", "0.6", "--json"]) == 0
    assert json.loads(capfd.readouterr().out)["cells"] > 0
    with World.open(out).package(0) as package:
        grid = package.visibility.grid
    assert grid.centers[:, 0].max() < 4.0 + 0.6 + grid.cell_size
    assert main(["world", scene, "-o", str(tmp_path / "d.gsworld"), "--path", str(tmp_path / "none.csv")]) == 2
    assert "none.csv" in capfd.readouterr().err


def test_cameras_of_a_world_are_eyes_of_its_tiles(
    scene: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Half of them stand on poles, where no rule of rooms and ground has eyes."""
    frames = []
    for k in range(16):
        pose = np.eye(4)
        pose[:3, :3] = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # looks along +x, z up
        pose[:3, 3] = 0.5 + 0.6 * k, 2.0, 1.5 if k % 4 < 2 else 3.6
        frames.append({"file_path": f"{k}.png", "transform_matrix": pose.tolist()})
    file, out = tmp_path / "transforms.json", tmp_path / "c.gsworld"
    file.write_text(json.dumps({"fl_x": 50.0, "w": 64, "h": 48, "frames": frames}))
    assert main(["world", scene, "-o", str(out), *SMALL, "--cells", "8", "--cameras", str(file), "--json"]) == 0
    assert json.loads(capfd.readouterr().out)["remarks"] == []
    world = World.open(out)
    eyes = [np.array(each["transform_matrix"])[:3, 3] for each in frames[::2]]
    for eye in eyes:
        with world.package(world.tile_at(eye)) as package:
            assert package.visibility.grid.cell_at(eye[None])[0] >= 0


def test_wrong_scenes_end_with_one_line(scene: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    out = ["-o", str(tmp_path / "c.gsworld")]
    for scenes, message in (
        ([], "SCENE: expected at least one scene, got none"),
        (["builtin:two_rooms"], "SCENE: expected a scene file, got builtin:two_rooms"),
        ([str(tmp_path / "none.ply")], "no such file or folder"),
        ([scene, scene], "SCENE: expected each scene once"),
    ):
        assert main(["world", *scenes, *out]) == 2
        error = capfd.readouterr().err
        assert message in error
        assert error.count("\n") == 1


def test_a_run_that_is_killed_again_and_again_ends_with_the_same_bytes(scene: str, tmp_path: Path) -> None:
    def start(out: Path) -> subprocess.Popen[bytes]:
        words = ["-m", "tests.few_views", "world", scene, "-o", str(out), *SMALL]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        return warm_start.Popen([sys.executable, *words], cwd=Path(__file__).parents[2], **quiet)

    whole, killed = tmp_path / "whole.gsworld", tmp_path / "killed.gsworld"
    assert main(["world", scene, "-o", str(whole), *SMALL]) == 0
    notes = tmp_path / "killed.gsworld.work" / "notes"
    for wanted in (2, 12):  # kill when so many tasks are finished
        process = start(killed)
        deadline = time.monotonic() + 120.0
        while process.poll() is None and time.monotonic() < deadline:
            if notes.is_dir() and sum(path.suffix == ".json" for path in notes.iterdir()) >= wanted:
                break
            time.sleep(0.005)
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert start(killed).wait() == 0
    assert cities.content(killed) == cities.content(whole)
    assert not any(path.is_dir() for path in (tmp_path / "killed.gsworld.work" / "work").iterdir())
