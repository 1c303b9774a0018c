"""What tests of `gsvis export` in leaves share: a scene, and refusals that write nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gsvis.cli import main
from gsvis.io import save_scene
from tests.export.test_needs import store_of, two_heaps


def heaps(folder: Path) -> Path:
    """Write two heaps of 200 Gaussians as a PLY; return its path."""
    save_scene(two_heaps(), folder / "s.ply")
    return folder / "s.ply"


def check_refused(
    words: list[str], wanted: str, kind: list[str], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Export with words that are wrong: one line that holds one of the parts of `wanted`, and every file as before.

    In the words, PLY is a scene, OTHER the visible sets of another one, FULL a folder of something else, OURS an
    earlier export of this kind, TILE and META files of it; NOTHING, NONE and OUT, with any suffix, are not there.
    """
    ply, ours = heaps(folder), folder / "ours"
    (folder / "full").mkdir()
    (folder / "full" / "notes.txt").write_text("mine")
    store_of(folder / "other.pvs", two_heaps(50), [np.arange(50)]).close()
    assert main(["export", str(ply), "-o", str(ours), *kind]) == 0
    capsys.readouterr()
    known = {"PLY": ply, "OTHER": folder / "other.pvs", "FULL": folder / "full", "OURS": ours}
    known |= {"NOTHING": folder / "nothing.ply", "NONE": folder / "none.pvs", "META": ours / "lod-meta.json"}
    known |= {name: folder / name.lower() for name in ("OUT", "OUT.glb", "OUT.gltf")}
    known["TILE"] = next(ours.glob("*.glb"), ours)
    before = files(folder)
    assert main(["export", *(str(known.get(word, word)) for word in words)]) == 2
    error = capsys.readouterr().err
    assert any(part in error for part in wanted.split("|")), error
    if "--leaf" not in words or "1" not in words:  # what tyro says of a value is a box
        assert len(error.strip().splitlines()) == 1
    assert files(folder) == before


def files(folder: Path) -> dict[Path, bytes]:
    """Return the content of all files in a folder and below it."""
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
