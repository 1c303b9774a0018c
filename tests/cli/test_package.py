"""`gsvis verify` and `gsvis unpack` at the command line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from gsvis.cli import main
from gsvis.io.levels import load_levels
from gsvis.package import write_package
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
