"""Small tasks for tests of graphs: pure, quick, and able to die, to wait and to fill a disk on request."""

from __future__ import annotations

import errno
import os
import signal
import time
from pathlib import Path

from gsvis.errors import FormatError, OutputError
from gsvis.jobs.graph import Facts, Given, Task

VERSIONS = {"count": 1, "join": 1, "fail": 1, "fill": 1, "die": 1, "slow": 1}
HERE = "tests.jobs.small_tasks"


def count(params: Facts, given: Given, out: Path, work: Path) -> Facts:
    (out / "number").write_bytes(b"%d" % params["value"])
    _note(params)
    return {"value": params["value"]}


def join(params: Facts, given: Given, out: Path, work: Path) -> Facts:
    total = sum(int(given.path(k, "number").read_bytes()) for k in range(len(given)))
    (out / "number").write_bytes(b"%d" % total)
    _note(params)
    return {"value": total}


def fail(params: Facts, given: Given, out: Path, work: Path) -> Facts:
    raise FormatError("tile 7", "", "a whole one", "a damaged one")


def fill(params: Facts, given: Given, out: Path, work: Path) -> Facts:
    raise OutputError("work", errno.ENOSPC)


def die(params: Facts, given: Given, out: Path, work: Path) -> Facts:
    """Kill the worker the first times, then answer as `count`; leaves a trace for the next attempt."""
    tries = Path(params["tries"])
    with tries.open("a") as file:
        file.write("x")
    if tries.stat().st_size <= params["deaths"]:
        (work / "half").write_bytes(b"half")
        os.kill(os.getpid(), signal.SIGKILL)
    return count({"value": int((work / "half").exists())}, given, out, work)


def slow(params: Facts, given: Given, out: Path, work: Path) -> Facts:
    time.sleep(params["seconds"])
    return count(params, given, out, work)


def tree(leaves: int, log: Path | None = None, run: str = "count") -> list[Task]:
    """Leaves, joined in pairs up to one."""
    note = {} if log is None else {"log": str(log)}
    names = [f"leaf {k}" for k in range(leaves)]
    tasks = [Task(name, f"{HERE}:{run}", {"value": k, **note}) for k, name in enumerate(names)]
    while len(names) > 1:
        joined = [f"({a} {b})" for a, b in zip(names[::2], names[1::2], strict=True)]
        for k, name in enumerate(joined):
            tasks.append(Task(name, f"{HERE}:join", note, tuple(names[2 * k : 2 * k + 2])))
        names = joined
    return tasks


def _note(params: Facts) -> None:
    if "log" in params:
        with open(params["log"], "a") as file:
            file.write("x")
