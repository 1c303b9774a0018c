"""`gsvis prepare` in this process: what it writes, says, refuses and keeps."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from gsvis.cli import main
from gsvis.cli.memory import check_memory
from gsvis.io import save_scene
from gsvis.io.levels import load_levels
from gsvis.package import Package
from gsvis.package.made_from import made_from_of
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.procedural import BUILTIN_SCENES, random_scene, two_rooms
from tests.few_views import take_few_views
from tests.scene.places import box

Capture = pytest.CaptureFixture[str]
SCENE = "builtin:wall_with_hole"
TINY = ["--cells", "2", "--face-size", "16", "--limit", "0.05", "--max-inner", "1", "--workers", "1"]
QUICK = [*TINY, "--max-terms", "0", "--steps", "2", "--views", "2", "--width", "24", "--height", "20"]
BOX = ["--box", "1", "1", "1", "7", "3", "2"]
FLAT = ["--levels", "none", "--max-terms", "0"]


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Nothing to compile, and views that do not matter."""
    made = replace(two_rooms(1000, sh_degree=1), navigable=NavigableSpace.from_box((1, 1, 1), (7, 3, 2), 12))
    monkeypatch.setitem(BUILTIN_SCENES, "wall_with_hole", lambda: made)
    for name in ("warm_sets", "warm_levels", "warm_colors"):
        monkeypatch.setattr(f"gsvis.cli.prepare.{name}", lambda config, status: None)
    with take_few_views():
        yield


def run(capsys: Capture, *words: Any, code: int = 0) -> tuple[str, str]:
    capsys.readouterr()
    got = main(["prepare", *map(str, words)])
    out, err = capsys.readouterr()
    assert got == code, err
    assert "Traceback" not in err
    return out, " ".join(err.split())


def refused(capsys: Capture, *words: Any) -> str:
    out, err = run(capsys, *words, code=2)
    assert out == ""
    return err


def test_a_scene_becomes_a_package_with_levels_and_tables(tmp_path: Path, capsys: Capture) -> None:
    target = tmp_path / "new" / "s.gsvis"
    text, _ = run(capsys, SCENE, "-o", target, *QUICK, "--meters-per-unit", "0.5")
    assert max(map(len, text.splitlines())) <= 80
    labels = ["low", "against the scene", "cost of rounding", "dB", "What a client gets", "records for exact values"]
    for label in (*labels, "proven to miss", "worst 16 x 16 tile", "+z; 0.5 meters", "s.gsvis.work", "made"):
        assert label in text
    with Package.open(target) as package:
        assert package.manifest.names == ("low", "medium", "high")
        assert package.verify().cells == 2
        about = package.manifest.info.provenance
    assert (about["scene"], about["config"]["levels"]["iterations"]) == (SCENE, 2)
    assert str(tmp_path) not in json.dumps(about)
    assert [each.name for each in made_from_of(about)] == [SCENE]
    assert main(["verify", str(target)]) == 0
    assert "0.5" in capsys.readouterr().out
    again, _ = run(capsys, SCENE, "-o", target, *QUICK, "--meters-per-unit", "0.5")
    assert again.count("there already") == 6
    assert main(["unpack", str(target), "-o", str(tmp_path / "levels"), "--json"]) == 0
    out = tmp_path / "again.gsvis"
    capsys.readouterr()
    whole = load_levels(tmp_path / "levels")
    found = json.loads(
        run(capsys, tmp_path / "levels", "-o", out, *TINY, *BOX, "--max-terms", "0", "--json", "--discard")[0]
    )
    assert [row["gaussians"] for row in found["levels"]] == list(whole.counts)
    with Package.open(out) as package:
        made = made_from_of(package.manifest.info.provenance)
    assert [(each.name, each.path) for each in made] == [("levels", "../levels")]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["again.gsvis", "levels", "new"]


def test_one_document_for_a_result_and_for_an_estimate(tmp_path: Path, capsys: Capture) -> None:
    target = tmp_path / "s.gsvis"
    words = [SCENE, "-o", target, *TINY, *FLAT, "--epsilon", "0.1"]
    asked = json.loads(run(capsys, *words, "--json", "--dry-run")[0])
    assert list(tmp_path.iterdir()) == []
    assert (asked["format"], asked["version"]) == ("gsvis-preparation-estimate", 1)
    assert asked["load"] is None or asked["load"] >= 0.0
    assert [stage["state"] for stage in asked["stages"]] == ["given", *["to do"] * 5]
    found = json.loads(run(capsys, *words, "--json")[0])
    assert (found["format"], found["version"]) == ("gsvis-preparation", 1)
    assert [stage["name"] for stage in found["stages"]] == [stage["name"] for stage in asked["stages"]]
    assert found["levels"] == [{"name": "high", "gaussians": found["gaussians"]}]
    assert found["bytes"] == sum(path.stat().st_size for path in (target / "parts").iterdir())
    assert found["cost"]["views"] == found["fidelity"]["views"] == 1
    assert list(found["fidelity"]["steps"]) == ["levels", "terms", "rounding", "cells"]
    assert found["meters_per_unit"] == 0.0
    assert found["certificates"]["cells"] == 2
    assert 0.0 <= found["certificates"]["tile"]["mean"] <= found["certificates"]["tile"]["max"] <= 1.0
    text, _ = run(capsys, *words, "--dry-run")
    assert "Nothing was written." in text
    assert text.count("done") == 4
    assert "memory" in text  # the other stages need some, too


def test_it_says_what_is_kept_when_it_is_stopped(
    tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(*words: Any, **named: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("gsvis.prepare.stage_quality.measure_cost", stop)
        _, err = run(capsys, SCENE, "-o", tmp_path / "s.gsvis", *TINY, *FLAT, code=130)
    assert "kept in s.gsvis.work; run the same command to resume" in err
    found = json.loads(run(capsys, SCENE, "-o", tmp_path / "s.gsvis", *TINY, *FLAT, "--json")[0])
    assert [stage["name"] for stage in found["stages"] if not stage["reused"]] == ["cost", "fidelity", "package"]


def test_cameras_of_photographs_say_where_eyes_are(tmp_path: Path, capsys: Capture) -> None:
    """Of two closed rooms the smaller one is taken where the photographs were taken in it."""
    small, large = (box(*corners, 0.1) for corners in (((0, 0, 0), (2, 2, 2)), ((3, 0, 0), (6, 3, 2))))
    save_scene(Gaussians.concatenate([small, large]), tmp_path / "rooms.ply")
    (tmp_path / "images").mkdir()
    frames = []
    for k in range(9):
        Image.fromarray(np.full((12, 16, 3), 128, np.uint8)).save(tmp_path / "images" / f"{k}.png")
        pose = np.eye(4)
        pose[:3, 3] = 0.8 + 0.04 * k, 1.0, 1.0
        frames.append({"file_path": f"images/{k}.png", "transform_matrix": pose.tolist()})
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 16.0, "w": 16, "h": 12, "frames": frames}))
    words = [tmp_path / "rooms.ply", "-o", tmp_path / "s.gsvis", *TINY, "--up", "+z", "--levels", "0.5", "--steps", "1"]
    words += ["--dry-run", "--json"]
    alone = json.loads(run(capsys, *words)[0])["space"]
    among = json.loads(run(capsys, *words, "--photos", tmp_path)[0])["space"]
    assert "holding seeds" in among["rule"]
    assert "holding seeds" not in alone["rule"]
    assert among["kind"]["eyes"] == "in the parts that hold the cameras"
    assert among["volume"] < 8.0 < alone["volume"]


def test_a_scene_that_does_not_fit_the_memory_is_refused_before_it_is_read(
    tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, target = tmp_path / "s.ply", tmp_path / "s.gsvis"
    save_scene(random_scene(np.random.default_rng(0), 3000), scene)
    monkeypatch.setattr("gsvis.cli.prepare.open_source", lambda *given: pytest.fail("the scene was read"))

    def least(*words: str) -> float:
        said = refused(capsys, scene, "-o", target, "--max-memory", "300MB", *words)
        assert "gsvis world" in said
        found = re.search(r"--max-memory: expected at least ([0-9.]+) ([GM])B", said)
        assert found is not None, said
        return float(found[1]) * (1000.0 if found[2] == "G" else 1.0)

    assert least("--levels", "none", *TINY) <= least(*TINY, "--views", "9") < least(*TINY, "--views", "400")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["s.ply"]


def test_what_a_line_asks_for_suffices(tmp_path: Path) -> None:
    scene = tmp_path / "s.ply"
    save_scene(random_scene(np.random.default_rng(0), 3000), scene)
    for kind in ("convert", "levels", "color"):
        with pytest.raises(ValueError, match="--max-memory: expected at least") as refusal:
            check_memory(kind, [(str(scene), None)], 1_000_000)
        found = re.search(r"at least ([0-9.]+) MB", str(refusal.value))
        assert found is not None
        check_memory(kind, [(str(scene), None)], round(float(found[1]) * 1e6))


def test_shares_that_are_too_small_are_named_under_a_limit_too(tmp_path: Path, capsys: Capture) -> None:
    scene = tmp_path / "s.ply"
    save_scene(random_scene(np.random.default_rng(0), 3), scene)
    said = refused(capsys, scene, "-o", tmp_path / "s.gsvis", "--max-memory", "8GB")
    assert "--levels: expected at least 2 Gaussians in each level" in said


def test_wrong_arguments_are_refused_at_once(tmp_path: Path, capsys: Capture) -> None:
    target = tmp_path / "s.gsvis"
    words = [SCENE, "-o", target]
    assert "--levels: expected each below the next" in refused(capsys, *words, "--levels", "0.5", "0.2")
    assert "expected shares in (0, 1]" in refused(capsys, *words, "--levels", "2")
    assert "larger shares" in refused(capsys, *words, "--levels", "0.001", *TINY)
    assert "--steps: expected none with --levels none" in refused(capsys, *words, "--levels", "none", "--steps", "7")
    assert "no such file" in refused(capsys, tmp_path / "none.ply", "-o", target)
    assert "no such file" in refused(capsys, *words, "--photos", tmp_path / "none")
    assert "--up: expected one of" in refused(capsys, *words, "--up", "q")
    assert "--views: expected none with --photos" in refused(capsys, *words, "--photos", tmp_path, "--views", "3")
    (tmp_path / "file").write_text("mine")
    assert "expected a folder" in refused(capsys, SCENE, "-o", tmp_path / "file")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.txt").touch()
    assert "thesis.txt" in refused(capsys, SCENE, "-o", tmp_path / "other")
    (tmp_path / "s.gsvis.work").write_text("mine")
    assert "s.gsvis.work" in refused(capsys, *words)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "other", "s.gsvis.work"]
