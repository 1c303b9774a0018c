"""`gsvis export` at the command line, with a stand-in for the built viewer."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from gsvis.cli import main
from gsvis.export import page
from gsvis.io import save_scene
from gsvis.package import write_package
from gsvis.scene.procedural import random_scene
from tests.export.test_static import Reader
from tests.export.viewers import viewer_of
from tests.package.worlds import colors_of, levels_of


@pytest.fixture(autouse=True)
def a_viewer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    viewer = viewer_of(tmp_path / "viewer")
    for write in (page.write_site, page.write_html):
        monkeypatch.setitem(write.__kwdefaults__, "viewer", viewer)


@pytest.fixture
def ply(tmp_path: Path) -> Path:
    save_scene(random_scene(np.random.default_rng(0), 80, sh_degree=1), tmp_path / "s.ply")
    return tmp_path / "s.ply"


def test_a_package_becomes_a_site(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_package(tmp_path / "s.gsvis", levels_of(120), colors_of(120)[1])
    assert main(["export", str(tmp_path / "s.gsvis"), "-o", str(tmp_path / "site")]) == 0
    output = " ".join(capsys.readouterr().out.split())
    assert "72 Gaussians" in output  # those of the highest level
    assert "any file server" in output
    assert "http.server" in output
    scene = Reader(tmp_path / "site" / "scene").scene
    assert (scene["name"], len(scene["levels"])) == ("s", 1)
    assert main(["export", str(tmp_path / "s.gsvis"), "-o", str(tmp_path / "site"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["kind"], found["gaussians"], found["cells"]) == ("static", 72, 1)
    for named, name in (([], "Our room"), (["--name", "room"], "room")):
        words = ["export", str(tmp_path / "s.gsvis"), "-o", str(tmp_path / "site"), "--title", "Our room", *named]
        assert main(words) == 0
        assert Reader(tmp_path / "site" / "scene").scene["name"] == name


def test_a_scene_becomes_one_file_and_that_is_not_replaced(
    ply: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["export", str(ply), "-o", str(tmp_path / "s.html"), "--format", "html", "--name", "Mine", "--up", "-y"]
    assert main(words) == 0
    assert "<title>Mine" in (tmp_path / "s.html").read_text(encoding="utf-8")
    capsys.readouterr()
    assert main(words) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert main([*words, "--overwrite", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["sh_degree"] == 1


@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        (["builtin:nowhere", "-o", "OUT"], "builtin"),
        (["none.ply", "-o", "OUT"], "no such file"),
        (["PLY", "-o", "OUT", "--format", "html"], ".html"),
        (["PLY", "-o", "PLY"], "folder"),
        (["PLY", "-o", "OUT", "--up", "sky"], "--up"),
        (["PACKAGE", "-o", "OUT", "--lod", "1"], "--lod"),
        (["PACKAGE", "-o", "OUT", "--kind", "rooms"], "--kind: expected none for a package"),
        (["PLY", "-o", "OUT", "--format", "3dtiles", "--kind", "rooms"], "--kind: expected --format static or html"),
        (["PLY", "-o", "OUT", "--show", "a.gif"], "--show: expected the name of a .png"),
        (["PACKAGE", "-o", "PACKAGE"], "outside of SCENE"),
        (["PACKAGE", "-o", "PACKAGE/site"], "outside of SCENE"),
    ],
)
def test_wrong_arguments_are_one_line_and_write_nothing(
    words: list[str], wanted: str, ply: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_package(tmp_path / "p.gsvis", levels_of(30), colors_of(30)[1])
    known = {"OUT": str(tmp_path / "out"), "PLY": str(ply), "PACKAGE": str(tmp_path / "p.gsvis")}
    known["PACKAGE/site"] = f"{known['PACKAGE']}/site"
    assert main(["export", *(known.get(word, word) for word in words)]) == 2
    error = capsys.readouterr().err
    assert wanted in error
    assert len(error.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_a_folder_of_something_else_stays(ply: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "index.html").write_text("mine")
    assert main(["export", str(ply), "-o", str(tmp_path / "site")]) == 2
    assert "something else" in capsys.readouterr().err
    assert (tmp_path / "site" / "index.html").read_text() == "mine"
    assert main(["export", str(ply), "-o", str(tmp_path / "site"), "--overwrite"]) == 0


def test_a_budget_makes_a_lighter_scene_and_says_what_it_costs(
    ply: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gsvis.edit.budget.SIDE", 32)
    words = [
        "export",
        str(ply),
        "-o",
        str(tmp_path / "s.glb"),
        "--format",
        "glb",
        "--box",
        "0",
        "0",
        "0",
        "1",
        "1",
        "1",
    ]
    assert main([*words, "--budget-splats", "40"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "of 80 Gaussians; at 12 other eyes a view has at most" in said
    assert "dB in the mean of other views" in said
    assert main([*words, "--budget-fill", "1e6", "--overwrite", "--json"]) == 0
    budget = json.loads(capsys.readouterr().out)["budget"]
    assert (budget["held"], budget["mean_db"]) == (True, 100.0)  # it held before
    write_package(tmp_path / "s.gsvis", levels_of(120), colors_of(120)[1])
    assert main(["export", str(tmp_path / "s.gsvis"), "-o", str(tmp_path / "site"), "--budget-fill", "5"]) == 2
    assert "--budget-fill: expected a scene, got a package" in capsys.readouterr().err
