"""Standard streams that are closed, full or have no reader: files are written all the same, nothing is a traceback."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from gsvis.cli import main
from gsvis.io import save_scene
from gsvis.scene.procedural import wall_with_hole
from tests import warm_start

pytestmark = pytest.mark.skipif(os.name == "nt", reason="uses a shell of Unix")


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scene") / "wall.ply"
    save_scene(wall_with_hole().gaussians[:40], path)
    return path


def run(redirections: str, code: str) -> subprocess.CompletedProcess[str]:
    command = shlex.join([sys.executable, "-c", code])
    return subprocess.run(["sh", "-c", f"exec {command} {redirections}"], capture_output=True, text=True, check=False)


@pytest.mark.parametrize("redirections", [">&-", "2>&-", "<&- >&- 2>&-"])
def test_closed_streams_change_no_file_and_no_exit_code(scene: Path, tmp_path: Path, redirections: str) -> None:
    wanted, found, codes = tmp_path / "wanted.spz", tmp_path / "found.spz", tmp_path / "codes.json"
    assert main(["convert", str(scene), str(wanted)]) == 0
    commands = {"--help": 0, f"convert {scene} {found}": 0, f"inspect {scene} --json": 0, "nothing": 2, "inspect no": 2}
    code = f"""
import json
from gsvis.cli import main
codes = [main(words.split()) for words in {list(commands)}]
with open({str(codes)!r}, "w") as file:
    json.dump(codes, file)
"""
    done = run(redirections, code)
    assert done.returncode == 0
    assert "Traceback" not in done.stderr
    assert json.loads(codes.read_text()) == list(commands.values())
    assert found.read_bytes() == wanted.read_bytes()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
@pytest.mark.parametrize("end", ["full", "no reader"])
def test_status_that_cannot_be_written_fails_no_command(scene: Path, tmp_path: Path, end: str) -> None:
    out = tmp_path / "a.spz"
    reading, writing = os.pipe()
    os.close(reading)
    status = os.open("/dev/full", os.O_WRONLY) if end == "full" else os.dup(writing)
    command = [sys.executable, "-m", "gsvis", "convert", str(scene), str(out), "--json"]
    try:
        done = warm_start.run(command, stdout=subprocess.PIPE, stderr=status, text=True, check=False)
    finally:
        os.close(writing)
        os.close(status)
    assert done.returncode == 0
    assert out.is_file()
    assert json.loads(done.stdout)["format"]
