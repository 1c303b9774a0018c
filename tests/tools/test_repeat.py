"""`tools/repeat.py`: what it counts, that it ends what hangs, and that nothing of it stays behind."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tools.repeat import run_once

ROOT = Path(__file__).resolve().parents[2]
SUMMARY = """
print("FAILED tests/a.py::test_x[1 - 2] - assert 1 == 2")
print("ERROR tests/b.py::test_y - OSError")
print("===== 1 failed, 3 passed, 1 error in 2.00s =====")
raise SystemExit(1)
"""


def repeated(out: Path, *words: str) -> tuple[int, dict[str, Any]]:
    command = [sys.executable, str(ROOT / "tools" / "repeat.py"), "--out", str(out), *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert out.exists(), done.stderr
    return done.returncode, json.loads(out.read_text())


def test_failures_are_counted_by_test(tmp_path: Path) -> None:
    words = ["--runs", "2", "--loops", "0", "--", sys.executable, "-c", SUMMARY]
    code, result = repeated(tmp_path / "out.json", *words)
    details = result["details"]
    assert code == 1
    assert (details["runs"], details["passed"]) == (2, 0)
    assert details["failures"] == {"tests/a.py::test_x[1 - 2]": 2, "tests/b.py::test_y": 2}
    assert details["each"][0]["tests"] == {"failed": 1, "passed": 3, "error": 1}
    assert result["figures"][0]["reached"] == 2


def test_a_run_that_passes_and_one_that_fails_without_a_summary(tmp_path: Path) -> None:
    code, result = repeated(tmp_path / "out.json", "--runs", "1", "--loops", "0", "--", sys.executable, "-c", "")
    assert (code, result["details"]["passed"], result["details"]["failures"]) == (0, 1, {})
    program = "print('make: stop'); raise SystemExit(2)"
    code, result = repeated(tmp_path / "out.json", "--runs", "1", "--loops", "0", "--", sys.executable, "-c", program)
    assert code == 1
    assert result["details"]["failures"] == {"exit code 2: make: stop": 1}


class WhenWritten:
    """A timer that ends a run once a file is there and not empty."""

    def __init__(self, path: Path, end: Callable[[], None]) -> None:
        self._path, self._end, self._over = path, end, threading.Event()
        self._watching = threading.Thread(target=self._watch)
        self.start, self.cancel = self._watching.start, self._over.set

    def _watch(self) -> None:
        while not (self._path.exists() and self._path.read_text()):
            if self._over.wait(0.05):
                return
        self._end()


def test_what_hangs_is_ended_with_its_children(tmp_path: Path) -> None:
    ids = tmp_path / "ids"
    program = f"""
import os, subprocess, sys, time
child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(3600)"])
open({str(ids)!r}, "w").write(f"{{os.getpid()}} {{child.pid}}")
time.sleep(3600)
"""
    command = [sys.executable, "-c", program]
    found = run_once(command, 9.0, dict(os.environ), timer=lambda _, end: WhenWritten(ids, end))
    assert found["failures"] == ["ended after 9 s"]
    child = Path(f"/proc/{ids.read_text().split()[1]}/stat")
    while child.exists() and child.read_text().rpartition(")")[2].split()[0] not in "ZX":  # killed, not yet gone
        time.sleep(0.05)
