"""Seconds of cores that a browser takes: by all its processes, or by the main thread of one page. Linux alone.

Wall time on a busy machine is mostly waiting for a core; these figures are disturbed by that little.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, NamedTuple


class Spent(NamedTuple):
    """Milliseconds of a thread: on a core, and ready to run without one."""

    ran: float
    waited: float

    def since(self, before: Spent) -> Spent:
        """Return what has been added."""
        return Spent(self.ran - before.ran, self.waited - before.waited)


def core_seconds() -> float:
    """Return seconds of all cores of the processes that this one has started, so far."""
    processes = _processes()
    return sum(processes[one][1] for one in _descendants(processes))


class PageThread:
    """The main thread of a page: the one of all renderers that runs while the page counts.

    Args:
        page: An open page of Playwright.
    """

    def __init__(self, page: Any) -> None:
        found = [Path(f"/proc/{one}/task/{one}/schedstat") for one in _descendants(_processes()) if _is_renderer(one)]
        before = [_spent(path).ran for path in found]
        page.evaluate("for (const end = performance.now() + 200; performance.now() < end;);")
        busy = [_spent(path).ran - ran for path, ran in zip(found, before, strict=True)]
        self._path = found[busy.index(max(busy))]

    def spent(self) -> Spent:
        """Return what it has taken so far."""
        return _spent(self._path)


def _spent(path: Path) -> Spent:
    ran, waited, _ = path.read_text().split()
    return Spent(int(ran) / 1e6, int(waited) / 1e6)


def _is_renderer(process: int) -> bool:
    try:
        return "--type=renderer" in Path(f"/proc/{process}/cmdline").read_text()
    except OSError:  # ended since
        return False


def _processes() -> dict[int, tuple[int, float]]:
    """Return the parent of each process, and the seconds of cores that it has taken."""
    found = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            words = path.read_text().rpartition(")")[2].split()
        except OSError:  # ended since
            continue
        found[int(path.parent.name)] = int(words[1]), (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")
    return found


def _descendants(processes: dict[int, tuple[int, float]]) -> set[int]:
    own, more = {os.getpid()}, {os.getpid()}
    while more := {child for child, (parent, _) in processes.items() if parent in more}:
        own |= more
    return own - {os.getpid()}
