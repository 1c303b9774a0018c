"""Where the processor time of the tests goes: `python tools/suite_time.py tests/cli --numprocesses 2`.

Runs pytest with the arguments, and prints the processor time of everything it started (browsers and servers too), then
the files that took most, with what their own processes took and how many they started. Seconds of the processor, which
other work on the machine changes much less than the time that passes.
"""

from __future__ import annotations

import ctypes
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

FOLDER = "GSVIS_SUITE_TIME"  # in the environment: where each process of pytest writes its rows
SHOWN = 30
_ADOPT = 36  # PR_SET_CHILD_SUBREAPER: processes whose parent ends become children of this one


class Clock:
    """A plugin of pytest: adds up for each file what this process and those that it waited for have used."""

    def __init__(self, folder: Path) -> None:
        self._out = folder / f"{os.getpid()}.json"
        self._last, self._started = used(), 0
        self.rows: defaultdict[str, list[float]] = defaultdict(lambda: [0.0, 0.0, 0.0])
        sys.addaudithook(self._hear)

    def _hear(self, event: str, _: object) -> None:
        self._started += event in ("subprocess.Popen", "os.fork", "os.posix_spawn")

    def note(self, name: str) -> None:
        """Add what has been used since the last note to a file."""
        now, row = used(), self.rows[name]
        for place, value in enumerate((now[0] - self._last[0], now[1] - self._last[1], float(self._started))):
            row[place] += value
        self._last, self._started = now, 0

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        """Run a test."""
        self.note("between tests")
        found = yield
        self.note(item.location[0])
        return found

    def pytest_collection_finish(self) -> None:
        """Note what it took to import the tests."""
        self.note("collection")

    def pytest_sessionfinish(self) -> None:
        """Write the rows."""
        self._out.write_text(json.dumps(self.rows))


def used() -> tuple[float, float]:
    """Return the processor time of this process and of the children that it waited for, seconds."""
    who = (resource.getrusage(which) for which in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    own, children = (found.ru_utime + found.ru_stime for found in who)
    return own, children


def pytest_configure(config: pytest.Config) -> None:
    """Register the plugin in each process of pytest."""
    config.pluginmanager.register(Clock(Path(os.environ[FOLDER])))


def wait_for_all(command: list[str], environment: dict[str, str]) -> tuple[int, float, float]:
    """Run a command and wait for all that it started; return its exit code, processor and passed seconds."""
    ctypes.CDLL(None).prctl(_ADOPT, 1, 0, 0, 0)
    began, before = time.monotonic(), used()[1]
    process = subprocess.Popen(command, env=environment)
    code = process.wait()
    while True:
        try:
            os.wait()
        except ChildProcessError:
            return code, used()[1] - before, time.monotonic() - began


def main(words: list[str]) -> int:
    """Run pytest and print where the time went."""
    with tempfile.TemporaryDirectory() as folder:
        here = str(Path(__file__).resolve().parent)
        paths = os.pathsep.join(filter(None, (here, os.environ.get("PYTHONPATH"))))
        environment = os.environ | {FOLDER: folder, "PYTHONPATH": paths}
        command = [sys.executable, "-m", "pytest", "-p", Path(__file__).stem, *words]
        code, processor, passed = wait_for_all(command, environment)
        total: dict[str, Any] = defaultdict(lambda: [0.0, 0.0, 0.0])
        for file in Path(folder).glob("*.json"):
            for name, row in json.loads(file.read_text()).items():
                total[name] = [one + more for one, more in zip(total[name], row, strict=True)]
    lines = [f"{processor:.0f} s of the processor, {passed:.0f} s passed", "    all  children  started  file"]
    for name, (own, children, started) in sorted(total.items(), key=lambda row: -sum(row[1][:2]))[:SHOWN]:
        lines.append(f"{own + children:7.1f}  {children:8.1f}  {started:7.0f}  {name}")
    sys.stdout.write("\n".join([*lines, ""]))
    return code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
