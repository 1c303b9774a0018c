"""Mistyped names get one line with a suggestion; `~` in a path is the home folder."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin

import pytest

from gsvis.cli import main, parse
from gsvis.cli.options import command_name, leaves, value_of
from gsvis.cli.spelling import _kinds, expand_home, is_path, misspelling, names_of
from gsvis.io import load_scene, save_scene
from gsvis.io.poses import load_path, write_poses
from gsvis.scene.paths import HeadPath
from gsvis.scene.procedural import two_rooms

Capture = pytest.CaptureFixture[str]

NOT_PATHS = {
    "change_up",
    "up",
    "page_origins",
    "scheduler",
    "host",
    "hosts",
    "token",
    "name",
    "names",
    "kind",
    "language",
    "classes",
    "origins",
    "proxies",
    "title",
    "backdrop",
    "accent",
    "embedders",
    "view",
}


def commands() -> list[tuple[str, type]]:
    return [(command_name(kind), kind) for kind in _kinds()]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["anlyze", "x", "-o", "y"], "no command 'anlyze'; did you mean analyze?"),
        (["pvsreport", "x"], "no command 'pvsreport'; did you mean pvs-report?"),
        (["scene.ply"], "no command 'scene.ply'; gsvis --help lists the commands"),
        (["--json", "inspect", "x"], "expected a command before '--json'"),
        (["convert", "a.ply", "b.ply", "--min-opacty", "1"], "no option --min-opacty; did you mean --min-opacity?"),
        (["convert", "a.ply", "b.ply", "--min_opacty=1"], "no option --min_opacty; did you mean --min-opacity?"),
        (["inspect", "x", "-lod", "1"], "gsvis inspect has no option -lod; did you mean --lod?"),
        (["render", "x", "--zzzz"], "gsvis render has no option --zzzz; gsvis render --help lists its options"),
        (["pvs", "x", "-o", "y", "--method", "hybrd"], "--method: expected one of hybrid, .* did you mean hybrid?"),
        (["pvs", "x", "-o", "y", "--method=rast"], "--method: expected one of .* did you mean raster?"),
        (["inspect", "builtin:two_room"], "builtin:nested_shells, or a path, .* did you mean builtin:two_rooms?"),
        (
            ["convert", "builtin:two_rooms", "/tmp/x.sgo"],
            "ends in .ply, .spz, .sog, .* got .*; did you mean .sog?",
        ),
        (["inspect", "builtin:attic"], "expected one of builtin:.* got 'builtin:attic'"),
    ],
)
def test_what_is_mistyped_is_reported_in_one_line(words: list[str], message: str, capsys: Capture) -> None:
    assert main(words) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert err.startswith("gsvis: error: ")
    assert re.search(message.replace("?", r"\?"), err), err


def test_every_name_is_known_and_a_lost_letter_is_found_again() -> None:
    for command, kind in commands():
        assert misspelling([command, "x", "--help"]) is None
        lost = f"{command[:2]}{command[3:]}"
        assert f"did you mean {command}?" in (misspelling([lost]) or "")
        names = [name for leaf in leaves(kind) for name in names_of(leaf) if name.startswith("--")]
        for name in names:
            assert misspelling([command, name.replace("-", "_").replace("__", "--")]) is None
            if len(name) > 7:
                text = misspelling([command, f"{name[:4]}{name[5:]}"]) or ""
                assert "did you mean --" in text


def test_names_are_those_of_the_documentation() -> None:
    text = (Path(__file__).parents[2] / "docs" / "cli.md").read_text(encoding="utf-8")
    documented = set(re.findall(r"^ *│? *(?:-\w [A-Z]+, )?(--[a-z][a-z-]+)", text, re.M))
    known = {name for _, kind in commands() for leaf in leaves(kind) for name in names_of(leaf)}
    assert len(documented) > 50
    assert documented - {"--help", "--version"} <= known


def test_values_that_look_like_options_are_left_alone() -> None:
    crop = ["--crop", "-1", "-2", "-3.5", "1e3", "2", "3"]
    assert misspelling(["convert", "a.ply", "b.ply", *crop, "--change-up", "-y:+z"]) is None
    assert misspelling(["render", "a.ply", "--up", "-y", "--target", "-.5", "0", "0"]) is None


def test_home_is_expanded_in_paths_and_in_nothing_else(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    for _, kind in commands():
        texts = {
            leaf.name for leaf in leaves(kind) if "str" in _plain(leaf.hint) and "Literal" not in _plain(leaf.hint)
        }
        paths = {leaf.name for leaf in leaves(kind) if is_path(leaf)}
        assert texts - paths <= NOT_PATHS
    command = parse(["simulate", "~/a.gsvis", "--path", "~/walk.csv", "--trace=~/link.csv", "-o", "~"])
    assert (command.package, command.path) == ((f"{tmp_path}/a.gsvis",), f"{tmp_path}/walk.csv")  # type: ignore[union-attr]
    assert expand_home(command) == command
    served = parse(["serve", "~/a", "b", "--token", "~/secret", "--ssl-certfile", "~/c.pem"])
    assert served.package == (f"{tmp_path}/a", "b")  # type: ignore[union-attr]
    assert value_of(served, "token") == "~/secret"
    assert value_of(served, "ssl_certfile") == f"{tmp_path}/c.pem"


def _plain(hint: Any) -> str:
    """Return the text of a type without the settings of tyro."""
    return str(get_args(hint)[0] if get_origin(hint) is Annotated else hint)


def test_home_is_expanded_by_the_library(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: Capture) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    scene = two_rooms().gaussians[:20]
    save_scene(scene, "~/scenes/a.ply")
    assert (tmp_path / "scenes" / "a.ply").is_file()
    assert len(load_scene("~/scenes/a.ply")) == 20
    assert main(["convert", "~/scenes/a.ply", "~/b.spz"]) == 0
    assert (tmp_path / "b.spz").is_file()
    write_poses(HeadPath([0, 1], [[0, 0, 0], [1, 0, 0]], [[1, 0, 0, 0]] * 2), "~/walk.csv")
    assert len(load_path("~/walk.csv")) == 2
    assert not (tmp_path / "~").exists()


def test_a_folder_that_is_called_like_home_is_that_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    home, here = tmp_path / "home", tmp_path / "here"
    home.mkdir()
    here.mkdir()
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.chdir(here)
    for name in ("b.ply", "b.spz", "b.sog"):
        (home / name).write_text("precious")
    scene = two_rooms().gaussians[:20]
    save_scene(scene, "./~/a.ply")
    save_scene(scene, Path("~") / "c.ply")
    for name in ("b.ply", "b.spz", "b.sog"):
        assert main(["convert", "./~/a.ply", f"./~/{name}"]) == 0
        assert len(load_scene(Path("~") / name)) == 20
        assert (home / name).read_text() == "precious"
    assert {path.name for path in (here / "~").iterdir()} == {"a.ply", "b.ply", "b.spz", "b.sog", "c.ply"}
    assert {path.name for path in home.iterdir()} == {"b.ply", "b.spz", "b.sog"}


@pytest.mark.parametrize("name", ["prepare", "color", "pvs", "levels", "cut", "export", "train"])
def test_a_target_behind_the_input_is_answered_with_the_option(name: str) -> None:
    message = misspelling([name, "in.ply", "my scene.out"])
    assert message == f"gsvis {name} writes where -o says: gsvis {name} in.ply -o 'my scene.out'"


@pytest.mark.parametrize(
    "words",
    [
        ["prepare", "in.ply"],
        ["prepare", "in.ply", "-o", "a.gsvis"],
        ["prepare", "in.ply", "--out=a.gsvis"],
        ["prepare", "in.ply", "--box", "1", "1", "1", "7", "3", "2"],
        ["convert", "in.ply", "out.spz"],
        ["serve", "a.gsvis", "b.gsvis"],
        ["inspect", "a.ply", "b.ply"],
    ],
)
def test_other_commands_are_left_to_the_parser(words: list[str]) -> None:
    assert misspelling(words) is None
