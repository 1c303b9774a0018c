"""The command as a process of its own: exit codes, streams, signals."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

from gsvis.io import save_scene
from gsvis.scene.procedural import wall_with_hole
from tests import warm_start
from tests.cli.halted import Halted

GSVIS = [sys.executable, "-m", "gsvis"]


def run(*words: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "GSVIS_DEBUG": "0"}
    return subprocess.run([*GSVIS, *words], capture_output=True, text=True, check=False, env=environment)


def test_help_and_version() -> None:
    done = run("--help")
    assert (done.returncode, done.stderr) == (0, "")
    for command in ("inspect", "analyze", "render", "convert"):
        assert command in done.stdout
    assert run().stdout == done.stdout
    assert run("--version").stdout.startswith("gsvis 0.")


def test_an_error_is_one_line_and_code_2() -> None:
    done = run("inspect", "nowhere.ply")
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr == "gsvis: error: nowhere.ply: no such file or folder\n"
    command = [*GSVIS, "inspect", "nowhere.ply", "--debug"]
    assert "Traceback" in warm_start.run(command, capture_output=True, text=True).stderr


def test_json_on_stdout_is_one_document_and_nothing_else(tmp_path: Path) -> None:
    save_scene(wall_with_hole().gaussians[:40], tmp_path / "wall.ply")
    done = run("inspect", str(tmp_path / "wall.ply"), "--json")
    assert done.returncode == 0
    assert json.loads(done.stdout)["format"] == "gsvis-inspection"


def test_a_reader_that_goes_away_is_no_error(tmp_path: Path) -> None:
    save_scene(wall_with_hole().gaussians[:40], tmp_path / "wall.ply")
    process = warm_start.Popen(
        [*GSVIS, "inspect", tmp_path / "wall.ply", "--json"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stderr is not None
    process.stdout.close()
    output = process.stderr.read()
    process.stderr.close()
    assert process.wait() == 141
    assert "Traceback" not in output
    assert "BrokenPipe" not in output


def test_ctrl_c_leaves_nothing_behind(tmp_path: Path) -> None:
    small = ["--views", "50", "--width", "32", "--height", "24", "--box", "1", "1", "1", "7", "3", "2"]
    stopped = Halted("cameras", 2, "analyze", "builtin:two_rooms", "-o", tmp_path / "out", *small)
    stopped.wait()
    code, _, text = stopped.end(signal.SIGINT)
    assert code == 130
    assert text.splitlines()[-1] == "gsvis: interrupted; nothing was left half-written"
    assert "Traceback" not in text
    assert list(tmp_path.iterdir()) == []
