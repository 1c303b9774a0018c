"""`gsvis simulate` in this process: what it prints, writes and refuses."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks._worlds import small_street
from gsvis.cli import main, parse
from gsvis.cli.arguments import Simulate
from gsvis.cli.memory import NEEDS, count_gaussians, expected_memory
from gsvis.cli.simulate import _originals
from gsvis.io import save_scene
from gsvis.io.poses import write_poses
from gsvis.package import in_package_order, write_package
from gsvis.package.original import Original
from gsvis.scene.levels import Levels
from gsvis.scene.paths import HeadPath
from gsvis.scene.procedural import two_rooms
from gsvis.world import World
from gsvis.world.prepare import prepare_world
from tests import warm_start
from tests.package.worlds import colors_of
from tests.simulate.streets import package_of, walk
from tests.world.cities import config

Capture = pytest.CaptureFixture[str]
QUICK = ["--seconds", "1", "--every", "0.5", "--width", "32", "--height", "24", "--mbit", "0.2"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A street and two rooms as packages, a walk, a link."""
    folder = tmp_path_factory.mktemp("packages")
    package_of(folder / "street", 400).close()
    rooms = in_package_order(Levels.single(two_rooms(1500).gaussians))
    write_package(folder / "rooms.gsvis", rooms, colors_of(len(rooms.union))[1]).close()
    save_scene(rooms.union, folder / "rooms.ply")
    write_poses(walk(3.0), folder / "walk.csv")
    (folder / "link.txt").write_text("0.5 0.1\n1.0 0.4\n")
    return folder


def street(folder: Path) -> str:
    return str(folder / "street" / "scene.gsvis")


def refused(capsys: Capture, *arguments: object) -> str:
    """The one line on stderr of a refusal; nothing on stdout. No stage is printed, however slow the machine."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gsvis.cli.terminal._QUIET", float("inf"))
        assert main([str(word) for word in arguments]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert len(err.splitlines()) == 1
    assert err.startswith("gsvis: error: ")
    return err


def test_it_writes_a_report_and_prints_tables(
    folder: Path, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    words = ["simulate", street(folder), "--path", str(folder / "walk.csv"), "-o", "report", "--no-retarget", *QUICK]
    assert main(words) == 0
    text = capsys.readouterr().out
    assert "report/report.html" in text.split()
    assert max(map(len, text.splitlines())) <= 80
    for label in ("QoE of a step", "whole file", "Morton order", "records sent twice", "0.2 Mbit/s"):
        assert label in text
    assert re.search(r"\d% of the path lies in cells of scene\.", " ".join(text.split()))
    names = {path.name for path in Path("report").iterdir()}
    assert {"report.html", "report.json", "qoe.png", "psnr.png", "latency.png", "bandwidth.png", "start.png"} <= names


@pytest.mark.usefixtures("blank_plots")
def test_json_is_the_document_and_its_command_makes_it_again(folder: Path, tmp_path: Path, capsys: Capture) -> None:
    words = ["simulate", street(folder), str(folder / "rooms.gsvis"), "--path", str(folder / "walk.csv")]
    words += ["-o", str(tmp_path), "--trace", str(folder / "link.txt"), "--visits", "3", "--no-retarget", *QUICK[:-2]]
    words += ["--policy", "fov-first", "--whole-file", str(folder / "walk.csv"), str(folder / "street")]
    assert main([*words, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document == json.loads((tmp_path / "report.json").read_text())
    assert parse(shlex.split(document["command"])[1:]) == parse(words)
    assert [visit["scene"]["name"] for visit in document["visits"]] == ["scene", "rooms", "scene"]
    assert [visit["path"]["from_s"] for visit in document["visits"]] == [0.0, 1.0, 2.0]
    assert document["visits"][0]["systems"][1]["about"]["bytes"] == (folder / "walk.csv").stat().st_size
    assert document["visits"][2]["systems"][0]["about"]["policy"] == "fov-first"
    for visit in document["visits"]:
        assert [system["figures"]["records_twice"] for system in visit["systems"]] == [0, 0, 0]


@pytest.mark.usefixtures("blank_plots")
def test_a_path_is_brought_into_the_scene_and_the_scene_can_be_given(
    folder: Path, tmp_path: Path, capsys: Capture
) -> None:
    words = ["simulate", str(folder / "rooms.gsvis"), "--path", str(folder / "walk.csv"), "-o", str(tmp_path)]
    assert main([*words, "--scene", str(folder / "rooms.ply"), *QUICK, "--json"]) == 0
    visit = json.loads(capsys.readouterr().out)["visits"][0]
    assert visit["path"]["inside"] > 0.9
    assert "unquantized" in visit["compared_with"]
    assert "SOG as gsvis writes it" in visit["systems"][1]["about"]["measured"]
    assert np.isfinite(visit["systems"][0]["curves"]["psnr"]).all()


def test_what_cannot_be_is_refused_in_one_line(folder: Path, tmp_path: Path, capsys: Capture) -> None:
    begin = ["simulate", street(folder), "--path", folder / "walk.csv", "-o", tmp_path / "report"]
    assert "no such file" in refused(capsys, *begin, "--trace", folder / "nothing")
    assert "leave it out" in refused(capsys, *begin, "--trace", folder / "link.txt", "--mbit", "3")
    assert "one for each package, 1, got 2" in refused(capsys, *begin, "--scene", "a.ply", "b.ply")
    assert "--whole-file: expected one for each" in refused(capsys, *begin, "--whole-file", "a", "b")
    assert "manifest" in refused(capsys, "simulate", folder, *begin[2:], "--no-retarget")
    (tmp_path / "bad.txt").write_text("1 2 3\n")
    assert "expected two numbers" in refused(capsys, *begin, "--trace", tmp_path / "bad.txt", "--no-retarget")
    (tmp_path / "empty").mkdir()
    assert "which is empty" in refused(capsys, *begin, "--whole-file", tmp_path / "empty", "--no-retarget")
    assert not (tmp_path / "report").exists()


@pytest.mark.usefixtures("blank_plots")
def test_a_scene_that_nobody_named_and_that_does_not_fit_is_left_out(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The package is compared with itself then; a scene that is named is an error."""
    package, scene = folder / "rooms.gsvis", folder / "rooms.ply"
    beside = Original(((str(scene), None),), ())
    monkeypatch.setattr("gsvis.cli.simulate.find_original", lambda *_: beside)
    alone = expected_memory("simulate", 1500, 0)
    both = alone + expected_memory("simulate", *count_gaussians(str(scene), None)) - NEEDS["simulate"].base
    command = parse(["simulate", str(package), "--path", "walk.csv", "-o", "report"])
    assert isinstance(command, Simulate)
    command = replace(command, max_memory=(alone + both) // 2)
    (found,) = _originals(command)
    assert found.scenes == ()
    assert found.remark.startswith("the scene it was made from is not read: --max-memory: expected at least")
    with pytest.raises(ValueError, match=r"^--max-memory: expected at least"):
        _originals(replace(command, scene=(str(scene),)))


def test_a_path_that_sees_nothing_has_no_headline(folder: Path, tmp_path: Path, capsys: Capture) -> None:
    path = walk(3.0)
    far = HeadPath(path.times, path.positions + np.array([0.0, 1e4, 0.0]), path.quats, path.up)
    write_poses(far, tmp_path / "far.csv")
    words = [
        "simulate",
        street(folder),
        "--path",
        str(tmp_path / "far.csv"),
        "-o",
        str(tmp_path / "out"),
        "--no-retarget",
    ]
    assert main([*words, *QUICK]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "The path sees nothing of scene in any of" in text
    assert "nothing to see" in text
    assert "0.1 s" not in text
    html = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "to an image of 35 dB" not in html
    assert "The path sees nothing of scene" in html
    assert main([*words, *QUICK, "--json"]) == 0
    out, err = capsys.readouterr()
    visit = json.loads(out)["visits"][0]
    assert visit["views"]["with_content"] == 0
    assert visit["systems"][0]["figures"]["score"] is None
    assert "The path sees nothing of scene" in err
    assert visit["path"]["in_cells"] == 0.0
    assert "Warning: only 0% of the path lies in cells of scene" in err


@pytest.fixture(scope="module")
def city(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A street as a world of some tiles, and the scenes that it was made of."""
    folder, g = tmp_path_factory.mktemp("worlds"), small_street(houses=2, step=0.5, flyaways=0)
    save_scene(g, folder / "street.ply")
    half = g.means[:, 0] < 6.0
    save_scene(g[half], folder / "left.ply")
    save_scene(g[~half], folder / "right.ply")
    prepare_world(
        [(str(folder / f"{name}.ply"), None) for name in ("left", "right")], folder / "city.gsworld", config()
    )
    return folder / "city.gsworld"


def gsvis(*words: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "gsvis", *(str(word) for word in words)]
    return warm_start.run(command, capture_output=True, text=True, check=False)


@pytest.mark.usefixtures("blank_plots")
def test_a_world_beside_a_package(city: Path, folder: Path, tmp_path: Path, capsys: Capture) -> None:
    words = ["simulate", city, street(folder), "--path", folder / "walk.csv", "-o", tmp_path, *QUICK, "--json"]
    assert main(list(map(str, words))) == 0
    document = json.loads(capsys.readouterr().out)
    world, package = document["visits"]
    assert world["scene"]["name"] == "city"
    assert world["scene"]["tiles"] == len(World.open(city).manifest.tiles) > 1
    assert "tiles" not in package["scene"]
    assert "tiles of the world" in world["compared_with"]
    assert np.isfinite(world["systems"][0]["curves"]["psnr"]).all()
    assert [system["figures"]["records_twice"] for system in world["systems"]] == [0, 0, 0]
    html = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert html.count("is a world of") == 1


@pytest.mark.usefixtures("blank_plots")
def test_a_world_alone_is_compared_with_all_of_its_scenes(city: Path, folder: Path, tmp_path: Path) -> None:
    words = ["simulate", str(city), "--path", str(folder / "walk.csv"), "-o", str(tmp_path / "a"), *QUICK]
    scenes = [str(city.parent / f"{name}.ply") for name in ("left", "right")]
    found = []
    for given in (scenes, [str(city.parent / "street.ply")]):
        assert main([*words, "--scene", *given, "--max-memory", "4GB"]) == 0
        found.append(json.loads((tmp_path / "a" / "report.json").read_text()))
    assert parse(shlex.split(found[1]["command"])[1:]) == parse([*words, "--scene", *given, "--max-memory", "4GB"])
    first, second = (each["visits"][0] for each in found)
    assert "unquantized" in first["compared_with"]
    assert first["systems"][0]["figures"] == second["systems"][0]["figures"]


def test_worlds_that_cannot_be_simulated_are_refused_in_one_line(
    city: Path, folder: Path, tmp_path: Path, capsys: Capture
) -> None:
    end = ["--path", folder / "walk.csv", "-o", tmp_path / "report", *QUICK]
    assert "expected at least" in refused(capsys, "simulate", city, *end, "--max-memory", "100MB")
    scenes = ["a.ply", "b.ply", "c.ply"]
    assert "one for each package, 2, got 3" in refused(capsys, "simulate", city, city, *end, "--scene", *scenes)
    (tmp_path / "empty").mkdir()
    assert "a world with a world.json, or a package" in refused(capsys, "simulate", tmp_path / "empty", *end)
    broken = Path(shutil.copytree(city, tmp_path / "broken.gsworld"))
    for part in World.open(broken).package_path(0).glob("parts/*.bin"):
        part.write_bytes(part.read_bytes()[:-1] + b"?")
    done = gsvis("simulate", broken, *end)
    assert (done.returncode, done.stdout) == (2, "")
    lines = [line for line in done.stderr.splitlines() if not line.startswith("gsvis: reading")]
    assert len(lines) == 1
    assert "damaged" in lines[0]
    assert not (tmp_path / "report").exists()
