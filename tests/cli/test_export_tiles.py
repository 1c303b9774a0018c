"""`gsvis export --format 3dtiles` and `glb` at the command line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from gsvis.cli import main
from gsvis.io import load_scene
from tests.cli.leaf_exports import check_refused, heaps
from tests.export.test_needs import store_of

TILES, GLB = ["--format", "3dtiles"], ["--format", "glb"]


@pytest.fixture
def ply(tmp_path: Path) -> Path:
    return heaps(tmp_path)


def test_a_scene_becomes_tiles(ply: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store_of(tmp_path / "s.pvs", load_scene(ply), [np.arange(100), np.arange(100, 150)]).close()
    words = ["export", str(ply), "-o", str(tmp_path / "out"), *TILES, "--leaf", "64"]
    assert main(words) == 0
    assert "4 tiles" in " ".join(capsys.readouterr().out.split())
    sets = ["--pvs", str(tmp_path / "s.pvs"), "--overwrite"]
    assert main([*words, *sets]) == 0
    assert "never seen from any cell 50, kept" in " ".join(capsys.readouterr().out.split())
    assert main([*words, *sets, "--request-volumes"]) == 0
    output = " ".join(capsys.readouterr().out.split())
    assert "leaves with a request volume 4 of 4" in output
    assert "leaves that no cell needs 0, left out" in output
    assert main([*words, *sets, "--never-seen", "drop", "--json", "--compression", "none"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["kind"], found["counts"], found["never_seen"], found["cells"]) == ("3dtiles", [150], 50, 2)
    assert found["bytes"] == sum(p.stat().st_size for p in (tmp_path / "out").iterdir())


def test_a_scene_becomes_one_file_that_is_a_scene(
    ply: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "a.glb"
    assert main(["export", str(ply), "-o", str(out), *GLB, "--up", "+y"]) == 0
    assert "200 Gaussians" in " ".join(capsys.readouterr().out.split())
    np.testing.assert_array_equal(load_scene(out).means, load_scene(ply).means)
    assert main(["inspect", str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["up"] == "+y"
    before = out.read_bytes()
    assert main(["export", str(ply), "-o", str(out), *GLB]) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert out.read_bytes() == before
    assert main(["export", str(ply), "-o", str(out), *GLB, "--overwrite", "--json", "--compression", "spz"]) == 0
    assert json.loads(capsys.readouterr().out)["bytes"] == out.stat().st_size < len(before)


@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        (["NOTHING", "-o", "OUT", *TILES], "no such file"),
        (["PLY", "-o", "OUT", *TILES, "--request-volumes"], "--request-volumes: expected a package or --pvs"),
        (["PLY", "-o", "OUT", *TILES, "--never-seen", "drop"], "visible sets"),
        (["PLY", "-o", "OUT", *TILES, "--pvs", "OTHER"], "another scene|of scene|Gaussians"),
        (["PLY", "-o", "OUT", *TILES, "--name", "Mine"], "--format static or html or streamed-sog"),
        (["PLY", "-o", "OUT", "--compression", "spz"], "--format 3dtiles or glb"),
        (["PLY", "-o", "OUT", "--meters-per-unit", "2"], "--format 3dtiles or glb"),
        (["PLY", "-o", "OUT", "--format", "streamed-sog", "--request-volumes"], "--format 3dtiles"),
        (["PLY", "-o", "OUT.glb", *GLB, "--leaf", "64"], "--format streamed-sog or 3dtiles"),
        (["PLY", "-o", "OUT.glb", *GLB, "--pvs", "OTHER"], "--format streamed-sog or 3dtiles"),
        (["PLY", "-o", "OUT.gltf", *GLB], "ends in .glb"),
        (["PLY", "-o", "PLY", *TILES], "a folder"),
        (["PLY", "-o", "FULL", *TILES, "--overwrite"], "something else"),
        (["PLY", "-o", "OURS", *TILES], "--overwrite"),
        (["TILE", "-o", "OURS", *TILES, "--overwrite"], "outside of SCENE"),
    ],
)
def test_wrong_arguments_are_one_line_and_write_nothing(
    words: list[str], wanted: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    check_refused(words, wanted, TILES, tmp_path, capsys)
