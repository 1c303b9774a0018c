"""Commands that only look take packages as they take scenes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from gsvis.cli import main
from gsvis.package import PackageInfo, write_package
from gsvis.package.package import Package
from gsvis.package.shown import is_package, load_shown
from gsvis.package.unpack import unpack_levels
from gsvis.pvs.store import VisibilityStore
from tests.package.worlds import colors_of, levels_of, sets_of
from tests.stream.worlds import package_of

Capture = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("shown") / "room.gsvis"
    package_of(folder, 2000, stores=False).close()
    return folder


def test_a_package_is_shown_as_what_unpack_writes_with_its_own_up(package: Path) -> None:
    source = load_shown(str(package), None)
    with Package.open(package) as opened:
        levels = unpack_levels(opened)
        up = opened.manifest.info.up
    assert source.levels is not None
    assert len(source.gaussians) == levels.counts[-1]
    np.testing.assert_array_equal(source.union.means, levels.union.means)
    assert source.known_up is not None
    np.testing.assert_allclose(source.known_up, up)
    assert is_package(str(package))
    assert not is_package("builtin:two_rooms")


def test_inspect_and_render_take_a_package(package: Path, tmp_path: Path, capsys: Capture) -> None:
    assert main(["inspect", str(package), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["count"] == len(load_shown(str(package), None).gaussians)
    picture = tmp_path / "room.png"
    assert main(["render", str(package), "-o", str(picture), "--width", "32", "--height", "24"]) == 0
    assert picture.stat().st_size > 0


def test_inspect_shows_the_overdraw_that_a_package_states(tmp_path: Path, capsys: Capture) -> None:
    levels, (_, colors) = levels_of(400), colors_of(400)
    sets = sets_of(tmp_path, levels)
    with VisibilityStore.open(sets) as store:
        cells = len(store)
    overdraw = {"splats": [9] * cells, "mean": [2.5] * cells, "worst": [7] * cells}
    for name, provenance in (("room", {}), ("stated", {"overdraw": overdraw})):
        info = PackageInfo(provenance=provenance)
        write_package(tmp_path / f"{name}.gsvis", levels, colors, info=info, visibility=sets).close()
    assert main(["inspect", str(tmp_path / "room.gsvis"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["cell_overdraw"] is None
    assert main(["inspect", str(tmp_path / "stated.gsvis"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["cell_overdraw"]
    assert len(found["cells"]) == cells
    assert found["largest"] == {"splats": 9, "mean": 2.5, "worst": 7}
    assert main(["inspect", str(tmp_path / "stated.gsvis")]) == 0
    assert "7 over the worst pixel" in capsys.readouterr().out


def test_a_package_has_no_lod(package: Path, capsys: Capture) -> None:
    assert main(["inspect", str(package), "--lod", "1"]) == 2
    assert "--lod: expected none for a package, got 1" in capsys.readouterr().err


@pytest.mark.parametrize(("file", "kind"), [("world.json", "a world"), ("scene.json", "a static scene")])
@pytest.mark.parametrize("command", ["render", "analyze"])
def test_what_was_published_is_named_with_what_shows_it(
    tmp_path: Path, capsys: Capture, file: str, kind: str, command: str
) -> None:
    (tmp_path / file).write_text("{}")
    assert main([command, str(tmp_path), "-o", str(tmp_path / "out")]) == 2
    line = capsys.readouterr().err
    assert f"expected a scene, got {kind}; gsvis view shows it" in line
    assert line.count("\n") == 1


def test_a_scene_given_to_serve_names_the_command_that_shows_it(tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "a.ply").write_bytes(b"ply\n")
    for scene in (str(tmp_path / "a.ply"), "builtin:two_rooms"):
        assert main(["serve", scene]) == 2
        assert f"look at it with gsvis view {scene}" in capsys.readouterr().err
    assert main(["serve", str(tmp_path / "none.ply")]) == 2
    assert capsys.readouterr().err == f"gsvis: error: {tmp_path / 'none.ply'}: no such file or folder\n"
