"""Counters, gauges and histograms, and their text as Prometheus reads it. No clock, no sockets.

Names follow Prometheus: seconds and bytes, `_total` for what only grows.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator, Sequence

__all__ = ["CONTENT_TYPE", "Counter", "Histogram", "Metrics"]

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"

_SECONDS = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)


class Counter:
    """A number for each value of one label; a gauge is a counter that is also taken from.

    Args:
        name: Of the metric.
        about: One line.
        kind: "counter" or "gauge".
        label: Name of the label; "" for none.
    """

    def __init__(self, name: str, about: str, kind: str = "counter", label: str = "") -> None:
        self.name, self.about, self.kind, self.label = name, about, kind, label
        self._values: dict[str, float] = {} if label else {"": 0.0}

    def add(self, value: float = 1.0, of: str = "") -> None:
        """Add to the number of this value of the label."""
        self._values[of] = self._values.get(of, 0.0) + value

    def set(self, value: float, of: str = "") -> None:
        """Put another number in its place."""
        self._values[of] = value

    def value(self, of: str = "") -> float:
        """The number now; 0 where nothing was added."""
        return self._values.get(of, 0.0)

    def lines(self) -> Iterator[str]:
        """The text of it."""
        yield f"# HELP {self.name} {self.about}"
        yield f"# TYPE {self.name} {self.kind}"
        for of, value in sorted(self._values.items()):
            labels = f'{{{self.label}="{_escaped(of)}"}}' if self.label else ""
            yield f"{self.name}{labels} {value:.17g}"


class Histogram:
    """How often values lay below each of some bounds.

    Args:
        name: Of the metric.
        about: One line.
        bounds: Rising.
    """

    def __init__(self, name: str, about: str, bounds: Sequence[float] = _SECONDS) -> None:
        self.name, self.about, self.bounds = name, about, tuple(bounds)
        self._counts = [0] * (len(self.bounds) + 1)
        self.sum = 0.0

    def observe(self, value: float) -> None:
        """Take in a value."""
        self._counts[bisect_left(self.bounds, value)] += 1
        self.sum += value

    @property
    def count(self) -> int:
        """How many values."""
        return sum(self._counts)

    def lines(self) -> Iterator[str]:
        """The text of it."""
        yield f"# HELP {self.name} {self.about}"
        yield f"# TYPE {self.name} histogram"
        below = 0
        for bound, count in zip(self.bounds, self._counts, strict=False):
            below += count
            yield f'{self.name}_bucket{{le="{bound:g}"}} {below}'
        yield f'{self.name}_bucket{{le="+Inf"}} {self.count}'
        yield f"{self.name}_sum {self.sum:.17g}"
        yield f"{self.name}_count {self.count}"


class Metrics:
    """All that a server counts.

    Attributes:
        clients: Streaming now.
        opened: Connections that became clients, by scene.
        closed: Clients that went or were sent away, by reason.
        refused: Requests that were turned away before they became clients, by reason.
        sent_bytes: Bytes of batches.
        batches: Batches.
        gaussians: Gaussians in them.
        terms: Terms in them.
        received: Messages of clients, by kind.
        skipped: Poses that were passed over, because there were too many or no such place is.
        parts: Answers for files of packages, by status.
        parts_bytes: Bytes of them.
        faults: Damaged parts and other faults of scenes, by scene.
        planning: Seconds from the decision to send to the batch as bytes.
        late: Seconds by which the event loop does later what is due, asked five times a second.
    """

    def __init__(self) -> None:
        self.clients = Counter("gsvis_clients", "Clients streaming now.", "gauge")
        self.opened = Counter("gsvis_clients_opened_total", "Clients that began to stream.", label="scene")
        self.closed = Counter("gsvis_clients_closed_total", "Clients that went or were sent away.", label="reason")
        self.refused = Counter("gsvis_refused_total", "Requests that were turned away.", label="reason")
        self.sent_bytes = Counter("gsvis_sent_bytes_total", "Bytes of batches.")
        self.batches = Counter("gsvis_batches_total", "Batches.")
        self.gaussians = Counter("gsvis_sent_gaussians_total", "Gaussians in batches.")
        self.terms = Counter("gsvis_sent_terms_total", "Terms in batches.")
        self.received = Counter("gsvis_received_messages_total", "Messages of clients.", label="kind")
        self.skipped = Counter("gsvis_skipped_poses_total", "Poses that were passed over.")
        self.parts = Counter("gsvis_parts_requests_total", "Requests for files of packages.", label="status")
        self.parts_bytes = Counter("gsvis_parts_bytes_total", "Bytes of files of packages.")
        self.faults = Counter("gsvis_scene_faults_total", "Damaged parts and other faults of scenes.", label="scene")
        self.planning = Histogram("gsvis_planning_seconds", "From the decision to send to the batch as bytes.")
        self.late = Histogram("gsvis_late_seconds", "By how much later than due the event loop does something.")

    def text(self) -> str:
        """What `/metrics` answers."""
        entries = [entry for entry in vars(self).values() if isinstance(entry, Counter | Histogram)]
        return "".join(f"{line}\n" for entry in entries for line in entry.lines())


def _escaped(value: str) -> str:
    return value.replace("\\", r"\\").replace('"', r"\"").replace("\n", r"\n")
