"""`gsvis verify` and `gsvis unpack` at the command line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from gsvis.cli import main
from gsvis.color import SrbfColors, quantize
from gsvis.io import save_scene
from gsvis.io.levels import load_levels
from gsvis.package import Contents, ExactLevel, PackageInfo, in_package_order, measure_fidelity, write_package
from gsvis.scene.cameras import Cameras
from gsvis.scene.levels import Levels
from gsvis.scene.procedural import box_in_room
from gsvis.scene.sh import SH_C0
from tests.package.worlds import NAMES, colors_of, levels_of


@pytest.fixture
def package(tmp_path: Path) -> Path:
    write_package(tmp_path / "s.gsvis", levels_of(120), colors_of(120)[1])
    return tmp_path / "s.gsvis"


def test_verify_prints_what_a_package_is(package: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["verify", str(package)]) == 0
    output = capsys.readouterr().out
    assert "Every part is whole." in output
    assert "bytes a Gaussian" in output
    assert "low " in output
    (package / "parts" / "stray.arrow").write_bytes(b"")
    assert main(["verify", str(package), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["gaussians"], found["strays"], found["cost"]) == (120, 1, None)
    assert sum(found["sizes"].values()) == sum(p.stat().st_size for p in (package / "parts").iterdir())
    assert [level["name"] for level in found["levels"]] == list(NAMES)


def test_verify_prints_what_is_wrong_in_one_line(package: Path, capsys: pytest.CaptureFixture[str]) -> None:
    part = next((package / "parts").iterdir())
    part.write_bytes(b"x" * part.stat().st_size)
    assert main(["verify", str(package)]) == 2
    assert part.name in capsys.readouterr().err.replace("\n", "")
    assert main(["verify", str(package / "none")]) == 2
    assert "no such file" in capsys.readouterr().err


def test_unpack_writes_a_ply_for_each_level(package: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["unpack", str(package), "-o", str(tmp_path / "out"), "--sh-degree", "1"]) == 0
    assert "high.ply" in capsys.readouterr().out
    assert load_levels(tmp_path / "out").union.sh_degree == 1
    assert main(["unpack", str(package), "-o", str(tmp_path / "out"), "--sh-degree", "0", "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["levels"]) == 3
    (tmp_path / "file").write_text("mine")
    assert main(["unpack", str(package), "-o", str(tmp_path / "file")]) == 2


@pytest.fixture
def measured(tmp_path: Path) -> Path:
    """A package that holds what a client gets of `scene.ply` beside it; its views see the scene from outside."""
    levels, (exact, packed) = in_package_order(Levels.single(levels_of(120).union)), colors_of(120)
    g = levels.union
    save_scene(g, tmp_path / "scene.ply")
    cameras = Cameras.orbit(g.means.mean(axis=0), 9.0, 2, width=32, height=24)
    found = measure_fidelity(g, Contents.from_levels(levels, packed), cameras, exact=ExactLevel(g, exact))
    write_package(tmp_path / "m.gsvis", levels, packed, info=PackageInfo(fidelity=found)).close()
    return tmp_path / "m.gsvis"


def test_verify_prints_what_a_client_gets(measured: Path, package: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["verify", str(measured)]) == 0
    text = capsys.readouterr().out
    assert max(map(len, text.splitlines())) <= 80
    for label in ("What a client gets", "records for exact values", "all of it, every record", "2 views of 32 x 24"):
        assert label in " ".join(text.split())
    assert main(["verify", str(measured), "--json"]) == 0
    kept = json.loads(capsys.readouterr().out)
    assert kept["fidelity_from"] == "measured by gsvis prepare"
    assert list(kept["fidelity"]["steps"]) == ["levels", "terms", "rounding"]
    assert main(["verify", str(package), "--json"]) == 0
    older = json.loads(capsys.readouterr().out)
    assert (older["fidelity"], older["fidelity_from"]) == (None, None)
    assert main(["verify", str(package)]) == 0
    assert "not measured; --scene SCENE" in capsys.readouterr().out


def test_verify_measures_against_a_scene(measured: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = str(measured.with_name("scene.ply"))
    assert main(["verify", str(measured), "--json"]) == 0
    kept = json.loads(capsys.readouterr().out)["fidelity"]
    assert main(["verify", str(measured), "--scene", scene, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["fidelity_from"] == f"measured against {scene}"
    assert found["fidelity"]["records"]["psnr"] == pytest.approx(kept["records"]["psnr"], abs=1e-2)
    assert found["fidelity"]["steps"] == kept["steps"]
    assert main(["verify", str(measured), "--scene", scene]) == 0
    assert "is scene the scene" not in " ".join(capsys.readouterr().out.split())
    assert main(["verify", str(measured), "--scene", "builtin:box_in_room"]) == 0
    assert "is builtin:box_in_room the scene from which" in " ".join(capsys.readouterr().out.split())


def test_verify_draws_views_where_a_package_has_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = box_in_room(1000, sh_degree=0)
    levels = in_package_order(Levels.single(made.gaussians))
    base = np.clip(0.5 + SH_C0 * levels.union.sh0[:, 0], 0.0, 1.0)
    write_package(tmp_path / "s", levels, quantize(SrbfColors.without_terms(base))).close()
    save_scene(made.gaussians, tmp_path / "scene.ply")
    assert main(["verify", str(tmp_path / "s"), "--scene", str(tmp_path / "scene.ply"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["fidelity"]
    assert (found["views"], found["width"], found["steps"], found["cell"]) == (12, 320, {}, None)
    assert 35 < found["records"]["worst"] <= found["records"]["psnr"] < 100


def test_a_scene_that_cannot_be_compared_is_refused(
    measured: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for words, wanted in (
        (["--lod", "1"], "--lod: expected none without --scene"),
        (["--scene", str(tmp_path / "none.ply")], "no such file"),
        (["--scene", "builtin:none"], "SCENE: expected one of"),
    ):
        assert main(["verify", str(measured), *words]) == 2
        error = capsys.readouterr().err
        assert wanted in error
        assert len(error.strip().splitlines()) == 1
