"""The command as a process of its own: exit codes, streams, signals."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

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
    assert "Traceback" in run("inspect", "nowhere.ply", "--debug").stderr


def test_json_on_stdout_is_one_document_and_nothing_else() -> None:
    done = run("inspect", "builtin:nested_shells", "--json")
    assert done.returncode == 0
    assert json.loads(done.stdout)["format"] == "gsvis-inspection"


def test_a_reader_that_goes_away_is_no_error() -> None:
    process = subprocess.Popen(
        [*GSVIS, "inspect", "builtin:two_rooms", "--json"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
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
    small = ["--views", "50", "--width", "32", "--height", "24"]
    stopped = Halted("cameras", 2, "analyze", "builtin:two_rooms", "-o", tmp_path / "out", *small)
    stopped.wait()
    code, _, text = stopped.end(signal.SIGINT)
    assert code == 130
    assert text.splitlines()[-1] == "gsvis: interrupted; nothing was left half-written"
    assert "Traceback" not in text
    assert list(tmp_path.iterdir()) == []
