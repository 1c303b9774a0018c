"""`gsvis export --format streamed-sog` at the command line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from gsvis.cli import main
from gsvis.io import load_scene, save_scene
from tests.export.test_needs import store_of, two_heaps

FORMAT = ["--format", "streamed-sog"]


@pytest.fixture
def ply(tmp_path: Path) -> Path:
    save_scene(two_heaps(), tmp_path / "s.ply")
    return tmp_path / "s.ply"


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
        (["OURS/lod-meta.json", "-o", "OURS", *FORMAT, "--overwrite"], "outside of SCENE"),
        (["PLY", "-o", "OURS", *FORMAT], "--overwrite"),
    ],
)
def test_wrong_arguments_are_one_line_and_write_nothing(
    words: list[str], wanted: str, ply: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").write_text("mine")
    store_of(tmp_path / "other.pvs", two_heaps(50), [np.arange(50)]).close()
    assert main(["export", str(ply), "-o", str(tmp_path / "ours"), *FORMAT]) == 0
    capsys.readouterr()
    known = {"PLY": ply, "OUT": tmp_path / "out", "NONE": tmp_path / "none.pvs", "OTHER": tmp_path / "other.pvs"}
    known |= {"FULL": tmp_path / "full", "OURS": tmp_path / "ours"}
    known["OURS/lod-meta.json"] = tmp_path / "ours" / "lod-meta.json"
    before = (tmp_path / "ours" / "lod-meta.json").read_bytes()
    assert main(["export", *(str(known.get(word, word)) for word in words)]) == 2
    error = capsys.readouterr().err
    assert any(part in error for part in wanted.split("|")), error
    if "--leaf" not in words or "1" not in words:  # what tyro says of a value is a box
        assert len(error.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()
    assert (tmp_path / "ours" / "lod-meta.json").read_bytes() == before
    assert [p.name for p in (tmp_path / "full").iterdir()] == ["notes.txt"]
