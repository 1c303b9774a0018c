"""`gsvis export --format streamed-sog` at the command line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from gsvis.cli import main
from gsvis.io import load_scene
from tests.cli.leaf_exports import check_refused, heaps
from tests.export.test_needs import store_of

FORMAT = ["--format", "streamed-sog"]


@pytest.fixture
def ply(tmp_path: Path) -> Path:
    return heaps(tmp_path)


def test_a_scene_and_its_sets_become_leaves(ply: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store_of(tmp_path / "s.pvs", load_scene(ply), [np.arange(100), np.arange(50, 150)]).close()
    words = ["export", str(ply), "-o", str(tmp_path / "out"), *FORMAT, "--pvs", str(tmp_path / "s.pvs"), "--leaf", "64"]
    assert main(words) == 0
    output = " ".join(capsys.readouterr().out.split())
    assert "4 leaves" in output
    assert "never seen from any cell 50, kept" in output
    assert main([*words, "--never-seen", "drop", "--overwrite", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["kind"], found["counts"], found["never_seen"], found["cells"]) == ("streamed-sog", [150], 50, 2)
    assert len(load_scene(tmp_path / "out" / "lod-meta.json")) == 150


def test_a_scene_that_viewers_would_turn_is_said_so(
    ply: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["export", str(ply), "-o", str(tmp_path / "out"), *FORMAT, "--overwrite", "--up"]
    assert main([*words, "+z"]) == 0
    assert "TURNED IN VIEWERS: up is +z" in (said := " ".join(capsys.readouterr().out.split()))
    assert "--change-up +z:-y" in said
    assert main([*words, "-y"]) == 0
    assert "TURNED" not in capsys.readouterr().out


def test_without_sets_it_says_so(ply: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", str(ply), "-o", str(tmp_path / "out"), *FORMAT]) == 0
    assert "gsvis pvs" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        (["PLY", "-o", "OUT", *FORMAT, "--never-seen", "drop"], "visible sets"),
        (["PLY", "-o", "OUT", *FORMAT, "--pvs", "NONE"], "no such file"),
        (["PLY", "-o", "OUT", *FORMAT, "--pvs", "PLY"], "a store of visible sets"),
        (["PLY", "-o", "OUT", *FORMAT, "--pvs", "OTHER"], "another scene|of scene|Gaussians"),
        (["PLY", "-o", "OUT", *FORMAT, "--leaf", "1"], "64 to 524288"),
        (["PLY", "-o", "OUT", "--leaf", "4096"], "--format streamed-sog"),
        (["PLY", "-o", "OUT", "--pvs", "OTHER"], "--format streamed-sog"),
        (["PLY", "-o", "OUT", "--format", "html", "--never-seen", "drop"], "--format streamed-sog"),
        (["PLY", "-o", "PLY", *FORMAT], "a folder"),
        (["PLY", "-o", "FULL", *FORMAT, "--overwrite"], "something else"),
        (["OURS", "-o", "OURS", *FORMAT, "--overwrite"], "outside of SCENE"),
        (["META", "-o", "OURS", *FORMAT, "--overwrite"], "outside of SCENE"),
        (["PLY", "-o", "OURS", *FORMAT], "--overwrite"),
    ],
)
def test_wrong_arguments_are_one_line_and_write_nothing(
    words: list[str], wanted: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    check_refused(words, wanted, FORMAT, tmp_path, capsys)
