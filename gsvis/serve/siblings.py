"""What the processes of one server know of each other: each writes one small file a second, and reads the others.

Nothing else is shared. So limits that hold for the server as a whole are as old as the files: at most some two seconds.
The files of processes that have ended stay, because their counters still count.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import prometheus_client
from prometheus_client import CollectorRegistry
from prometheus_client.metrics_core import Metric

from gsvis.errors import FormatError
from gsvis.files.atomic import atomic_path
from gsvis.files.limits import read_whole
from gsvis.serve.metrics import Metrics

__all__ = ["Siblings"]

_STALE_S = 10.0  # a process that has not written for so long does not count
_SUMMED = ("counter", "histogram")  # kinds of metrics that go on counting after their process has ended


@dataclass(frozen=True)
class _Report:
    """What a process wrote last."""

    number: int
    age_s: float
    value: dict[str, Any]


class Siblings:
    """The processes of one server, as one of them sees them.

    Args:
        folder: Folder of the files, one server's own.
        number: Number of this process, from 0.
        age: Returns the seconds since a file was written; for tests.
        beat: Gives a sign of life; a server calls it once a second, in its event loop.
    """

    def __init__(
        self,
        folder: Path,
        number: int,
        *,
        age: Callable[[Path], float] | None = None,
        beat: Callable[[], None] = lambda: None,
    ) -> None:
        self.folder = folder
        self.number = number
        self._age = age or _age_of
        self.beat = beat
        self.path = folder / f"process-{number}-{os.getpid()}.json"
        self._others: list[_Report] = []

    def publish(self, metrics: Metrics, seats: dict[str, int], health: tuple[int, int]) -> None:
        """Write what others need to know, and read what they wrote.

        Args:
            metrics: Counters of this process.
            seats: Number of viewers of each address.
            health: Scenes that are served, and scenes that are refused.
        """
        value = {"seats": seats, "health": health, "families": _families_of(metrics)}
        with suppress(OSError), atomic_path(self.path, sweep=False) as partial:
            partial.write_text(json.dumps(value))
        self._others = list(self._read())

    @property
    def alive(self) -> int:
        """Number of processes that serve, this one included."""
        return 1 + len(self._living())

    def seats_of(self, owner: str) -> tuple[int, int]:
        """Return how many viewers the other processes have, in all and of one address."""
        found = [report.value["seats"] for report in self._living()]
        return sum(sum(seats.values()) for seats in found), sum(seats.get(owner, 0) for seats in found)

    def is_ahead(self, viewers: int) -> bool:
        """Return whether this process has more viewers than another one."""
        return any(viewers > sum(report.value["seats"].values()) for report in self._living())

    def text(self, metrics: Metrics) -> str:
        """Return the text of `/metrics` for all processes: sums, and for `process_*` a label `process`."""
        living = self._living()
        found = dict[str, _Family]()
        _add(found, _families_of(metrics), self.number, is_alive=True)
        for report in self._others:
            _add(found, report.value["families"], report.number, is_alive=report in living)
        return prometheus_client.generate_latest(_Merged(found.values())).decode()

    def _read(self) -> Iterator[_Report]:
        """Yield what the other processes wrote; skip files that cannot be read."""
        for path in sorted(self.folder.glob("process-*.json")):
            if path == self.path:
                continue
            with suppress(OSError, ValueError, FormatError):
                yield _Report(int(path.name.split("-")[1]), self._age(path), json.loads(read_whole(path)))

    def _living(self) -> list[_Report]:
        """Return the reports of the other processes that live: for each number the newest, unless it is old."""
        newest: dict[int, _Report] = {}
        for report in sorted(self._others, key=lambda each: -each.age_s):
            if report.number != self.number and report.age_s < _STALE_S:
                newest[report.number] = report
        return list(newest.values())


class _Family:
    """The samples of one metric, summed over processes."""

    def __init__(self, name: str, about: str, kind: str) -> None:
        self.name = name
        self.about = about
        self.kind = kind
        self.samples: dict[str, tuple[str, dict[str, str], float]] = {}

    def add(self, name: str, labels: dict[str, str], value: float) -> None:
        key = json.dumps([name, labels], sort_keys=True)
        before = self.samples[key][2] if key in self.samples and self.kind != "info" else 0.0
        self.samples[key] = name, labels, before + value


class _Merged(CollectorRegistry):
    """A registry of families that are summed already."""

    def __init__(self, families: Iterable[_Family]) -> None:
        super().__init__()
        self._families = list(families)

    def collect(self) -> Iterator[Metric]:
        for family in self._families:
            metric = Metric(family.name, family.about, family.kind)
            for sample in family.samples.values():
                metric.add_sample(*sample)
            yield metric


def _families_of(metrics: Metrics) -> list[Any]:
    """Return the metrics of this process as JSON holds them."""
    return [
        [f.name, f.documentation, f.type, [[s.name, s.labels, s.value] for s in f.samples]]
        for f in metrics.registry.collect()
    ]


def _add(found: dict[str, _Family], families: list[Any], number: int, *, is_alive: bool) -> None:
    """Add the metrics of a process; of one that has ended, only what it counted."""
    for name, about, kind, samples in families:
        of_process = name.startswith("process_")
        if not is_alive and (of_process or kind not in _SUMMED):
            continue
        family = found.setdefault(name, _Family(name, about, kind))
        for sample, labels, value in samples:
            if not sample.endswith("_created"):
                family.add(sample, {**labels, "process": str(number)} if of_process else labels, value)


def _age_of(path: Path) -> float:
    """Return the seconds since a file was written."""
    return time.time() - path.stat().st_mtime
