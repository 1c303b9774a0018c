"""Run one command of gsvis in this process, and record what each stage of its progress cost.

`python _metered.py RECORD WORDS...` runs `gsvis WORDS...` and writes a list of stages as JSON: name, wall seconds,
processor seconds of this process and of those that ended below it, and the peak of its resident memory. A stage lasts
until the next one begins, so what runs between two stages belongs to the earlier.
"""

from __future__ import annotations

import json
import resource
import sys
import time
from pathlib import Path
from typing import Any

from gsvis.cli import main
from gsvis.cli.terminal import Status

__all__ = ["Meter"]

START = "start"


class Meter:
    """The cost of the stages of this process, one after the other.

    Attributes:
        stages: Records of those that ended.
    """

    def __init__(self) -> None:
        self.stages: list[dict[str, Any]] = []
        self._name = START
        self._begin()

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
            "peak_gb": round(_peak_bytes() / 1e9, 4),
        }
        self.stages.append(record)

    def _begin(self) -> None:
        self._began = time.perf_counter(), _processor_seconds()
        Path("/proc/self/clear_refs").write_text("5")  # the peak begins again


def _processor_seconds() -> float:
    """Return the processor time of this process and of its ended children."""
    taken = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in taken)


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
