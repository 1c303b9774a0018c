"""A folder of levels where a scene is expected: visible sets and colors are those of all levels together."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from gsvis.cli import main
from gsvis.color import load_srbf, srbf_info
from gsvis.io.levels import MAP, load_levels, save_levels
from gsvis.io.sources import load_source
from gsvis.pvs import VisibilityStore
from gsvis.scene.levels import Levels
from gsvis.scene.procedural import two_rooms

Capture = pytest.CaptureFixture[str]
CELLS = ["--cells", "4", "--face-size", "16", "--workers", "1", "--certify", "256", "--max-inner", "1"]
BOX = ["--box", "0.5", "0.5", "0.5", "3.5", "3.5", "2.5"]
TERMS = ["--views", "2", "--held-out", "1", "--width", "32", "--height", "24", "--max-terms", "1", "--mean-terms", "1"]
TERMS += ["--color-steps", "0"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    g = two_rooms(1000, sh_degree=1).gaussians
    kind = np.random.default_rng(0).choice(3, len(g), p=[0.3, 0.1, 0.6])
    levels = Levels(g, np.array([0, 0, 1])[kind], np.array([1, 0, 1])[kind], ("low", "high"))
    path = tmp_path_factory.mktemp("in") / "rooms"
    save_levels(levels, path)
    return path


def run(capsys: Capture, *words: object) -> dict:
    capsys.readouterr()
    assert main([*map(str, words), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def refused(capsys: Capture, *words: object) -> str:
    capsys.readouterr()
    assert main([*map(str, words)]) == 2
    return " ".join(capsys.readouterr().err.split())


def test_pictures_show_the_highest_level(folder: Path) -> None:
    source, levels = load_source(str(folder), None), load_levels(folder)
    assert source.name == "rooms"
    assert np.array_equal(source.gaussians.means, levels.level(1).means)
    assert np.array_equal(source.union.means, levels.union.means)


@pytest.mark.usefixtures("blank_plots")
def test_sets_and_colors_of_a_folder_of_levels(folder: Path, tmp_path: Path, capsys: Capture) -> None:
    levels = load_levels(folder)
    expected = [{"name": name, "gaussians": n} for name, n in zip(levels.names, levels.counts, strict=True)]
    estimate = run(capsys, "pvs", folder, "-o", tmp_path / "rooms.pvs", *CELLS, *BOX, "--dry-run")
    found = run(capsys, "pvs", folder, "-o", tmp_path / "rooms.pvs", *CELLS, *BOX)
    assert estimate["levels"] == found["levels"] == expected
    assert found["gaussians"] == len(levels.union)
    with VisibilityStore.open(tmp_path / "rooms.pvs", scene=levels) as store:
        assert store.gaussians == len(levels.union)
        assert len(store.ever_visible()) > 0
    files = ["--pvs", tmp_path / "rooms.pvs", "--active", tmp_path / "terms.arrow", "--epsilon", "0.02"]
    out = tmp_path / "rooms.arrow"
    fitted = run(capsys, "color", folder, "-o", out, *files, *TERMS, "--report", tmp_path / "report")
    assert fitted["levels"] == expected
    assert fitted["gaussians"] == len(levels.union)
    assert fitted["quality"]["all_terms"]["psnr"]["mean"] > 20.0
    geometry, colors = load_srbf(out)
    assert np.array_equal(geometry.means, levels.union.means)
    assert len(colors) == len(levels.union)
    assert srbf_info(out).provenance["levels"] == expected
    assert (tmp_path / "report" / "report.html").exists()
    report = ["pvs-report", tmp_path / "rooms.pvs", folder, "-o", tmp_path / "sets", "--cells", "1"]
    measured = run(capsys, *report, "--eyes", "1", "--dense", "0", "--width", "32", "--height", "24")
    assert measured["quality"]["figures"]["weighted_recall"]["mean"] > 0.8


def test_what_a_folder_of_levels_cannot_do_is_refused(folder: Path, tmp_path: Path, capsys: Capture) -> None:
    before = (folder / MAP).read_bytes()
    output = refused(capsys, "pvs", folder, "-o", tmp_path / "x.pvs", "--lod", "1", *CELLS)
    assert "--lod: expected none for a folder of levels" in output
    assert "which is read" in refused(capsys, "color", folder, "-o", folder / MAP, *TERMS)
    assert "which is read" in refused(capsys, "color", folder, "-o", folder / "low.ply", *TERMS)
    assert "something else" in refused(capsys, "pvs", folder, "-o", folder / MAP, *CELLS)
    assert (folder / MAP).read_bytes() == before
