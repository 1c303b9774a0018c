"""Memory of a process and of all below it: their proportional set sizes (PSS), and the peak while a block runs."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

__all__ = ["Peak", "pss", "tree", "watch_memory"]


@dataclass
class Peak:
    """The largest memory of this process and those below it.

    Attributes:
        bytes: PSS of all together; shared pages are split among those who share them.
        at: Seconds from the start of the block.
        processes: Bytes of each at that time, largest first.
        samples: How often they were read.
    """

    bytes: int = 0
    at: float = 0.0
    processes: list[int] = field(default_factory=list)
    samples: int = 0


def tree(pid: int) -> list[int]:
    """A process and all below it."""
    found = [pid]
    try:
        for task in Path(f"/proc/{pid}/task").iterdir():
            for child in (task / "children").read_text().split():
                found += tree(int(child))
    except OSError:
        pass
    return found


def pss(pid: int) -> int:
    """Bytes; 0 for a process that is gone."""
    try:
        for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines():
            if line.startswith("Pss:"):
                return 1024 * int(line.split()[1])
    except OSError:
        pass
    return 0


@contextmanager
def watch_memory(every: float) -> Iterator[Peak]:
    """Follow the memory of this process and those below it while the block runs.

    Args:
        every: Seconds between samples; shorter peaks may go unseen. Reading costs some 10 ms a gigabyte.
    """
    peak, done, began = Peak(), threading.Event(), time.perf_counter()

    def follow() -> None:
        while True:
            each = sorted((size for pid in tree(os.getpid()) if (size := pss(pid))), reverse=True)
            peak.samples += 1
            if sum(each) > peak.bytes:
                peak.bytes, peak.at, peak.processes = sum(each), time.perf_counter() - began, each
            if done.wait(every):
                return

    thread = threading.Thread(target=follow, daemon=True)
    thread.start()
    try:
        yield peak
    finally:
        done.set()
        thread.join()
