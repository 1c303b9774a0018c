"""Run one command of gsvis in this process, and record what each stage of its progress cost.

`python _metered.py RECORD WORDS...` runs `gsvis WORDS...` and writes a list of stages as JSON: name, wall seconds,
processor seconds of this process and of all below it, and the peak of their memory: resident memory of this process
alone, or proportional memory of all while there are others, read every two seconds. A stage lasts until the next one
begins, so what runs between two stages belongs to the earlier.
"""

from __future__ import annotations

import json
import os
import resource
import sys
import threading
import time
from pathlib import Path
from typing import Any

from _memory import pss, tree

from gsvis.cli import main
from gsvis.cli.terminal import Status

__all__ = ["Meter"]

START = "start"
_EVERY = 2.0  # seconds between readings of the memory of all processes
_TICKS = os.sysconf("SC_CLK_TCK")  # of processor time, a second


class Meter:
    """The cost of the stages of this process, one after the other.

    Attributes:
        stages: Records of those that ended.
    """

    def __init__(self) -> None:
        self.stages: list[dict[str, Any]] = []
        self._name = START
        self._together = 0
        self._begin()
        threading.Thread(target=self._follow, daemon=True).start()

    def enter(self, name: str) -> bool:
        """Record the stage so far and begin another one, unless it is the same; return whether it is another."""
        if name == self._name:
            return False
        self.end()
        self._name = name
        self._begin()
        return True

    def end(self) -> None:
        """Record the stage so far."""
        wall, processor = self._began
        record = {
            "name": self._name,
            "wall_s": round(time.perf_counter() - wall, 3),
            "cpu_s": round(_processor_seconds() - processor, 3),
            "peak_gb": round(max(_peak_bytes(), self._together) / 1e9, 4),
        }
        self.stages.append(record)

    def _begin(self) -> None:
        self._began = time.perf_counter(), _processor_seconds()
        self._together = 0
        Path("/proc/self/clear_refs").write_text("5")  # the peak begins again

    def _follow(self) -> None:
        """Note the largest memory of all processes together, for as long as this one lives."""
        while True:
            processes = tree(os.getpid())
            if len(processes) > 1:
                self._together = max(self._together, sum(map(pss, processes)))
            time.sleep(_EVERY)


def _processor_seconds() -> float:
    """Return the processor time of this process and of all below it, those that ended too."""
    taken = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    ended = sum(each.ru_utime + each.ru_stime for each in taken)
    return ended + sum(map(_seconds_of, tree(os.getpid())[1:]))


def _seconds_of(pid: int) -> float:
    """Return the processor time of a process and of its ended children; 0 for a process that is gone."""
    try:
        after_name = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    except OSError:
        return 0.0
    return sum(map(int, after_name[11:15])) / _TICKS


def _peak_bytes() -> int:
    """Return the largest resident memory since it was last reset."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM:"):
            return 1024 * int(line.split()[1])
    return 0


def run(record: Path, words: list[str]) -> int:
    """Run a command; return its exit code."""
    meter = Meter()
    show = Status.__call__

    def called(status: Status, stage: str, done: int, total: int) -> None:
        """Note the stage before it is shown; the record so far outlives a run that is stopped."""
        if meter.enter(stage):
            record.write_text(json.dumps(meter.stages))
        show(status, stage, done, total)

    setattr(Status, "__call__", called)  # noqa: B010
    code = main(words)
    meter.end()
    record.write_text(json.dumps(meter.stages))
    return code


if __name__ == "__main__":
    sys.exit(run(Path(sys.argv[1]), sys.argv[2:]))
