"""Run a command of tests several times, beside busy loops, and write how often it passed and what failed.

    python tools/repeat.py --runs 5 --loops 2 --cold --out docs/results/stress.json -- .venv/bin/pytest tests/serve

It ends with 0 where no run failed. Failed tests are those that pytest names in its summary. A run that takes longer
than --limit is ended and counts as failed. The loops end with this program, and after --limit in any case.

Given: the command, the number of runs, the busy loops beside each.
Measured: runs that failed and the tests that did, seconds and load average of each run.
Defaults chosen on: no scene.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import re
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks._harness import write_result

_LOOP = """
import os, sys, time
parent, end = int(sys.argv[1]), time.monotonic() + float(sys.argv[2])
while os.getppid() == parent and time.monotonic() < end:
    sum(range(10_000_000))
"""
_NAMED = re.compile(r"^(?:FAILED|ERROR) ([^\s\[]+(?:\[.*?\](?= - |$))?)")
_COUNTED = re.compile(r"\b(\d+) (passed|failed|errors?|skipped)\b")
_SAMPLED = 5.0  # seconds between looks at the load


@contextlib.contextmanager
def busy(count: int, limit: float) -> Iterator[None]:
    """Keep `count` loops running, at the longest for `limit` seconds."""
    command = [sys.executable, "-c", _LOOP, str(os.getpid()), str(limit)]
    loops = [subprocess.Popen(command) for _ in range(count)]
    try:
        yield
    finally:
        for loop in loops:
            loop.kill()
        for loop in loops:
            loop.wait()


@contextlib.contextmanager
def load_averages() -> Iterator[list[float]]:
    """Collect the load average while the block runs."""
    found, done = [os.getloadavg()[0]], threading.Event()

    def watch() -> None:
        while not done.wait(_SAMPLED):
            found.append(os.getloadavg()[0])

    watching = threading.Thread(target=watch, daemon=True)
    watching.start()
    try:
        yield found
    finally:
        done.set()
        watching.join()


def run_once(
    command: Sequence[str], limit: float, environment: dict[str, str], timer: Callable[..., Any] = threading.Timer
) -> dict[str, Any]:
    """Return what one run did: its exit code, seconds, counts of tests and the names of those that failed."""
    began, lines, ended = time.monotonic(), [], False
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment, start_new_session=True
    )

    def end() -> None:
        nonlocal ended
        ended = True
        os.killpg(process.pid, signal.SIGKILL)

    guard = timer(limit, end)
    guard.start()
    try:
        assert process.stdout is not None
        for line in process.stdout:
            sys.stdout.write(line)
            sys.stdout.flush()
            lines.append(line.rstrip("\n"))
        process.stdout.close()
        code = process.wait()
    finally:
        guard.cancel()
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
    counts: Counter[str] = Counter()
    for line in lines:
        if re.search(r" in \d+\.\d+s", line):  # the last line of a run of pytest
            counts.update({kind.rstrip("s"): int(number) for number, kind in _COUNTED.findall(line)})
    failures = [match[1] for line in lines if (match := _NAMED.match(line))]
    if ended:
        failures.append(f"ended after {limit:g} s")
    elif code and not failures:
        failures.append(f"exit code {code}: {lines[-1] if lines else ''}"[:300])
    return {
        "exit_code": code,
        "seconds": round(time.monotonic() - began, 1),
        "tests": dict(counts),
        "failures": failures,
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--loops", type=float, default=2.0, help="busy loops for each core")
    parser.add_argument("--limit", type=float, default=3600.0, help="seconds until a run counts as hanging")
    parser.add_argument("--cold", action="store_true", help="begin with no compiled kernels; later runs have them")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("command", nargs="+")
    asked = parser.parse_args()
    if asked.runs < 1 or asked.loops < 0.0 or asked.limit <= 0.0:
        parser.error(f"expected --runs 1 or more, --loops 0 or more, --limit above 0; got {vars(asked)}")
    cores = len(os.sched_getaffinity(0))
    loops, found = round(asked.loops * cores), []
    with contextlib.ExitStack() as stack:
        environment = dict(os.environ)
        if asked.cold:
            environment["NUMBA_CACHE_DIR"] = stack.enter_context(tempfile.TemporaryDirectory(prefix="kernels-"))
        loads = stack.enter_context(load_averages())
        stack.enter_context(busy(loops, asked.limit * asked.runs))
        for number in range(1, asked.runs + 1):
            print(f"run {number} of {asked.runs}, beside {loops} busy loops on {cores} cores", flush=True)
            found.append(run_once(asked.command, asked.limit, environment))
    failed = Counter(name for run in found for name in run["failures"])
    passed = sum(not run["failures"] and run["exit_code"] == 0 for run in found)
    figure = {
        "name": "runs that failed",
        "target": 0,
        "reached": len(found) - passed,
        "unit": "runs",
        "better": "lower",
    }
    details = {
        "repeated": " ".join(asked.command),
        "busy_loops": loops,
        "cold_kernels": asked.cold,
        "load_average": {"median": round(statistics.median(loads), 2), "most": round(max(loads), 2)},
        "runs": len(found),
        "passed": passed,
        "failures": dict(failed.most_common()),
        "seconds": round(sum(run["seconds"] for run in found), 1),
        "each": found,
    }
    write_result(asked.out, f"Does this pass {len(found)} times in a row beside busy loops?", [figure], details)
    return 0 if passed == len(found) else 1


if __name__ == "__main__":
    sys.exit(main())
