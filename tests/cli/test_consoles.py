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


def run(encoding: str, *commands: list[object]) -> tuple[list[int], str, str]:
    """Run commands in one process; return their exit codes, and all that they print and report."""
    environment = {**os.environ, "PYTHONIOENCODING": encoding}
    words = [[str(word) for word in command] for command in commands]
    code = f"from gsvis.cli import main; codes = [main(words) for words in {words}]; print(codes)"
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, encoding=encoding, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    said, _, codes = done.stdout.rstrip("\n").rpartition("\n")
    return json.loads(codes), said, done.stderr


@pytest.mark.parametrize("encoding", ["cp1252", "utf-8"])
def test_names_that_a_console_lacks_are_escaped(scene: Path, tmp_path: Path, encoding: str) -> None:
    out = tmp_path / f"{NAME}.spz"
    words: list[object] = ["convert", scene, out]
    codes, said, refused = run(encoding, [*words, "--json"], words, [*words, "--overwrite"])
    assert codes == [0, 2, 0]
    assert out.is_file()
    document, end = json.JSONDecoder().raw_decode(said)
    assert NAME in json.dumps(document, ensure_ascii=False)
    assert ("日本" if encoding == "utf-8" else "\\u65e5\\u672c") in refused
    assert "40 Gaussians" in " ".join(said[end:].split())
