"""A console that cannot print a name shows it escaped, and never fails a command."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from gsvis.io import save_scene
from gsvis.scene.procedural import wall_with_hole

NAME = "日本 \N{CAT FACE} scan"


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("named") / f"{NAME}.ply"
    save_scene(wall_with_hole().gaussians[:40], path)
    return path


def run(encoding: str, *words: object) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONIOENCODING": encoding}
    command = [sys.executable, "-m", "gsvis", *map(str, words)]
    return subprocess.run(command, capture_output=True, encoding=encoding, env=environment, check=False)


@pytest.mark.parametrize("encoding", ["cp1252", "utf-8"])
def test_names_that_a_console_lacks_are_escaped(scene: Path, tmp_path: Path, encoding: str) -> None:
    out = tmp_path / f"{NAME}.spz"
    done = run(encoding, "convert", scene, out, "--json")
    assert done.returncode == 0, done.stderr
    assert out.is_file()
    assert NAME in json.dumps(json.loads(done.stdout), ensure_ascii=False)
    again = run(encoding, "convert", scene, out)
    assert again.returncode == 2
    assert ("日本" if encoding == "utf-8" else "\\u65e5\\u672c") in again.stderr
    lines = run(encoding, "convert", scene, out, "--overwrite")
    assert lines.returncode == 0, lines.stderr
    assert "40 Gaussians" in " ".join(lines.stdout.split())
