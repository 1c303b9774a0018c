"""What a server counts, kept by prometheus_client in a registry of the server's own, and its text for Prometheus.

Names follow Prometheus: seconds and bytes, `_total` for what only grows. No sockets. Safe to use from any
thread.
"""

from __future__ import annotations

import platform
from collections.abc import Iterator, Sequence
from importlib.metadata import PackageNotFoundError, version

import prometheus_client
from prometheus_client import CollectorRegistry, Info, ProcessCollector
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

__all__ = ["CONTENT_TYPE", "Counter", "Gauge", "Histogram", "Metrics"]

CONTENT_TYPE: str = prometheus_client.CONTENT_TYPE_LATEST

_SECONDS = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)


class Counter:
    """A number that only grows, for each value of one label.

    Args:
        registry: Where it is listed.
        name: Of the metric.
        about: One line.
        label: Name of the label; "" for none.
    """

    def __init__(self, registry: CollectorRegistry, name: str, about: str, label: str = "") -> None:
        self.name, self._label = name, label
        self._metric = prometheus_client.Counter(name, about, [label] if label else [], registry=registry)
        self._children: dict[str, prometheus_client.Counter] = {} if label else {"": self._metric}

    def add(self, value: float = 1.0, of: str = "") -> None:
        """Add to the number of this value of the label."""
        child = self._children.get(of)
        if child is None:
            child = self._children[of] = self._metric.labels(of)
        child.inc(value)

    def value(self, of: str = "") -> float:
        """Return the number now; 0 where nothing was added."""
        return _sample(self._metric, self.name, {self._label: of} if self._label else {})


class Gauge:
    """A number that rises and falls.

    Args:
        registry: Where it is listed.
        name: Of the metric.
        about: One line.
    """

    def __init__(self, registry: CollectorRegistry, name: str, about: str) -> None:
        self.name = name
        self._metric = prometheus_client.Gauge(name, about, registry=registry)

    def add(self, value: float = 1.0) -> None:
        """Add to the number."""
        self._metric.inc(value)

    def set(self, value: float) -> None:
        """Replace the number."""
        self._metric.set(value)

    def value(self) -> float:
        """Return the number now."""
        return _sample(self._metric, self.name, {})


class Histogram:
    """How often values lie below each of some bounds.

    Args:
        registry: Where it is listed.
        name: Of the metric.
        about: One line.
        bounds: Rising.
    """

    def __init__(self, registry: CollectorRegistry, name: str, about: str, bounds: Sequence[float] = _SECONDS) -> None:
        self.name, self.bounds = name, tuple(bounds)
        self._metric = prometheus_client.Histogram(name, about, buckets=self.bounds, registry=registry)

    def observe(self, value: float) -> None:
        """Count a value."""
        self._metric.observe(value)

    @property
    def count(self) -> int:
        """How many values."""
        return int(_sample(self._metric, f"{self.name}_count", {}))

    @property
    def sum(self) -> float:
        """Their sum."""
        return _sample(self._metric, f"{self.name}_sum", {})


class Metrics:
    """All that a server counts.

    Attributes:
        registry: What `/metrics` shows. It is this object's alone: two servers of a process count apart.
        clients: Streaming now.
        opened: Connections that became clients, by scene.
        closed: Clients that went or were sent away, by reason.
        refused: Requests that were turned away before they became clients, by reason; those that no application
            saw by their HTTP status.
        cut: Connections that were cut, by reason; a viewer that gets the reason counts in `closed`.
        accept_failures: Connections that could not be accepted, by the name of the error.
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
        self.registry = r = CollectorRegistry()
        Info("gsvis_build", "Versions of what serves.", registry=r).info(_build())
        self.clients = Gauge(r, "gsvis_clients", "Clients streaming now.")
        self.opened = Counter(r, "gsvis_clients_opened_total", "Clients that began to stream.", "scene")
        self.closed = Counter(r, "gsvis_clients_closed_total", "Clients that went or were sent away.", "reason")
        self.refused = Counter(r, "gsvis_refused_total", "Requests that were turned away.", "reason")
        self.cut = Counter(r, "gsvis_cut_total", "Connections that were cut.", "reason")
        self.accept_failures = Counter(r, "gsvis_accept_failures_total", "Connections not accepted.", "error")
        self.sent_bytes = Counter(r, "gsvis_sent_bytes_total", "Bytes of batches.")
        self.batches = Counter(r, "gsvis_batches_total", "Batches.")
        self.gaussians = Counter(r, "gsvis_sent_gaussians_total", "Gaussians in batches.")
        self.terms = Counter(r, "gsvis_sent_terms_total", "Terms in batches.")
        self.received = Counter(r, "gsvis_received_messages_total", "Messages of clients.", "kind")
        self.skipped = Counter(r, "gsvis_skipped_poses_total", "Poses that were passed over.")
        self.parts = Counter(r, "gsvis_parts_requests_total", "Requests for files of packages.", "status")
        self.parts_bytes = Counter(r, "gsvis_parts_bytes_total", "Bytes of files of packages.")
        self.faults = Counter(r, "gsvis_scene_faults_total", "Damaged parts and other faults of scenes.", "scene")
        self.planning = Histogram(r, "gsvis_planning_seconds", "From the decision to send to the batch as bytes.")
        self.late = Histogram(r, "gsvis_late_seconds", "By how much later than due the event loop does something.")
        ProcessCollector(registry=r)

    def text(self) -> str:
        """Return what `/metrics` answers."""
        return prometheus_client.generate_latest(_WithoutCreated(self.registry)).decode()


class _WithoutCreated(CollectorRegistry):
    """A registry without the times at which each series began: they double the page, and the process has one.

    The library switches them off for a whole process only.
    """

    def __init__(self, registry: CollectorRegistry) -> None:
        super().__init__()
        self._of = registry

    def collect(self) -> Iterator[Metric]:
        for family in self._of.collect():
            family.samples = [sample for sample in family.samples if not sample.name.endswith("_created")]
            yield family


def _sample(metric: Collector, name: str, labels: dict[str, str]) -> float:
    """Return the value of one series; 0 where there is none."""
    samples = (sample for family in metric.collect() for sample in family.samples)
    return next((sample.value for sample in samples if sample.name == name and sample.labels == labels), 0.0)


def _build() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for name in ("gsvis", "uvicorn", "websockets"):
        try:
            found["version" if name == "gsvis" else name] = version(name)
        except PackageNotFoundError:  # run from its sources
            found["version" if name == "gsvis" else name] = "unknown"
    return found
