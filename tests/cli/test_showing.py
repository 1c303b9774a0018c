"""Commands show where people stand: in doubt beside the output, with --show in a file, always in a report."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from PIL import Image

from gsvis.cli import main
from gsvis.io import save_scene
from gsvis.scene.procedural import two_rooms
from tests.scene.places import statue

Capture = pytest.CaptureFixture[str]
DRY = ["--cells", "4", "--workers", "1", "--limit", "0.05", "--max-inner", "1", "--dry-run"]


@pytest.fixture
def pictures_of_places() -> None:
    """Draw them here."""


def test_a_dry_run_in_doubt_shows_both_readings(tmp_path: Path, capsys: Capture) -> None:
    scene, out = tmp_path / "statue.ply", tmp_path / "s.pvs"
    save_scene(statue()[::4], scene)
    assert main(["pvs", str(scene), "-o", str(out), "--face-size", "16", "--certify", "256", *DRY]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "Not sure: the scene was taken for " in text
    assert f"Where people stand: {out}.where.png shows the first view and a plan with eyes." in text
    assert text.endswith("Nothing else was written.")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["s.pvs.where.png", "statue.ply"]
    with Image.open(f"{out}.where.png") as image:
        assert image.size[0] == 1280


def test_without_doubt_there_is_a_picture_where_it_is_asked_for(tmp_path: Path, capsys: Capture) -> None:
    scene = tmp_path / "in" / "rooms.ply"
    scene.parent.mkdir()
    save_scene(two_rooms(1500, sh_degree=0).gaussians, scene)
    shown = tmp_path / "rooms.png"
    words = [
        "pvs",
        str(scene),
        "--up",
        "+z",
        "-o",
        str(tmp_path / "s.pvs"),
        "--face-size",
        "16",
        "--certify",
        "256",
        *DRY,
        "--json",
    ]
    assert main([*words, "--show", str(shown)]) == 0
    assert any(str(shown) in each for each in json.loads(capsys.readouterr().out)["remarks"])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in", "rooms.png"]
    assert main([*words, "--show", str(shown)]) == 0  # a picture of gsvis is replaced
    assert main(words) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in", "rooms.png"]


def test_a_report_holds_the_picture(tmp_path: Path) -> None:
    scene = tmp_path / "rooms.ply"
    save_scene(two_rooms(1500, sh_degree=0).gaussians, scene)
    assert (
        main(["clean", str(scene), "--eyes", "2", "--held-out", "0", "--report", str(tmp_path / "r"), "--up", "+z"])
        == 0
    )
    assert "Where people stand" in (tmp_path / "r" / "report.html").read_text(encoding="utf-8")
    with Image.open(tmp_path / "r" / "where.png") as image:
        assert image.size[0] == 1280
    assert sorted(path.name for path in tmp_path.iterdir()) == ["r", "rooms.ply"]
