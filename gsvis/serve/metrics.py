"""The metrics of a server, in its own registry of prometheus_client, and their text for Prometheus.

Names follow Prometheus: seconds and bytes, `_total` for counters. No sockets. Safe to use from any thread.
"""

from __future__ import annotations

import platform
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version

import prometheus_client
from prometheus_client import CollectorRegistry, Info, ProcessCollector
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

__all__ = ["CONTENT_TYPE", "Counter", "Gauge", "Histogram", "Metrics", "SceneMetrics", "SentMetrics"]

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
        self.name = name
        self._label = label
        self._metric = prometheus_client.Counter(name, about, [label] if label else [], registry=registry)
        self._children: dict[str, prometheus_client.Counter] = {} if label else {"": self._metric}

    def add(self, value: float = 1.0, of: str = "") -> None:
        """Add to the number of this value of the label."""
        child = self._children.get(of)
        if child is None:
            child = self._children[of] = self._metric.labels(of)
        child.inc(value)

    def value(self, of: str = "") -> float:
        """Return the current number; 0 if nothing was added."""
        return _sample(self._metric, self.name, {self._label: of} if self._label else {})


class Gauge:
    """A number that can increase and decrease.

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
        """Return the current number."""
        return _sample(self._metric, self.name, {})


class Histogram:
    """Counts of the values below each of some bounds.

    Args:
        registry: Where it is listed.
        name: Of the metric.
        about: One line.
        bounds: The bounds, ascending.
    """

    def __init__(self, registry: CollectorRegistry, name: str, about: str, bounds: Sequence[float] = _SECONDS) -> None:
        self.name = name
        self.bounds = tuple(bounds)
        self._metric = prometheus_client.Histogram(name, about, buckets=self.bounds, registry=registry)

    def observe(self, value: float) -> None:
        """Count a value."""
        self._metric.observe(value)

    @property
    def count(self) -> int:
        """Number of values."""
        return int(_sample(self._metric, f"{self.name}_count", {}))

    @property
    def sum(self) -> float:
        """Sum of the values."""
        return _sample(self._metric, f"{self.name}_sum", {})


@dataclass(frozen=True)
class SentMetrics:
    """What viewers were sent.

    Attributes:
        bytes: Bytes of batches.
        batches: Number of batches.
        gaussians: Gaussians in the batches.
        terms: Terms in the batches.
    """

    bytes: Counter
    batches: Counter
    gaussians: Counter
    terms: Counter

    @classmethod
    def in_registry(cls, registry: CollectorRegistry) -> SentMetrics:
        """Return the metrics, listed in a registry."""
        return cls(
            bytes=Counter(registry, "gsvis_sent_bytes_total", "Bytes of batches."),
            batches=Counter(registry, "gsvis_batches_total", "Batches."),
            gaussians=Counter(registry, "gsvis_sent_gaussians_total", "Gaussians in batches."),
            terms=Counter(registry, "gsvis_sent_terms_total", "Terms in batches."),
        )


@dataclass(frozen=True)
class SceneMetrics:
    """What happens to scenes.

    Attributes:
        faults: Damaged parts and other faults, by scene.
        tables_bytes: Bytes of kept tables in memory, approximately.
        tables_released: How often the memory of the tables of a scene was given back, by scene.
        open: Number of open scenes.
        opened: Scenes opened for a viewer after they were closed, by scene.
        closed: Scenes closed because nobody used them, by scene.
    """

    faults: Counter
    tables_bytes: Gauge
    tables_released: Counter
    open: Gauge
    opened: Counter
    closed: Counter

    @classmethod
    def in_registry(cls, registry: CollectorRegistry) -> SceneMetrics:
        """Return the metrics, listed in a registry."""
        released = "Tables whose memory was given back."
        return cls(
            faults=Counter(registry, "gsvis_scene_faults_total", "Damaged parts and other faults of scenes.", "scene"),
            tables_bytes=Gauge(registry, "gsvis_tables_bytes", "Bytes of kept tables in memory, about."),
            tables_released=Counter(registry, "gsvis_tables_released_total", released, "scene"),
            open=Gauge(registry, "gsvis_open_scenes", "Scenes that are open."),
            opened=Counter(registry, "gsvis_scenes_opened_total", "Scenes opened again for a viewer.", "scene"),
            closed=Counter(registry, "gsvis_scenes_closed_total", "Scenes closed without viewers.", "scene"),
        )


class Metrics:
    """The metrics of a server.

    Attributes:
        registry: The registry that `/metrics` shows. Each object has its own, so two servers of a process count apart.
        clients: Clients that stream now.
        opened: Connections that became clients, by scene.
        closed: Clients that left or were disconnected, by reason.
        refused: Requests refused before they became clients, by reason; by HTTP status if the application did not see
            them.
        cut: Connections that were cut, by reason; a viewer that gets the reason counts in `closed`.
        accept_failures: Connections that could not be accepted, by the name of the error.
        sent: What viewers were sent.
        received: Messages of clients, by kind.
        skipped: Poses ignored because there were too many.
        parts: Answers for files of packages, by status.
        parts_bytes: Bytes of these answers.
        scenes: What happens to scenes.
        planning: Seconds from the decision to send until the batch is encoded.
        late: Seconds by which the event loop runs late, with the wait for a turn, measured five times a second.
    """

    def __init__(self) -> None:
        self.registry = r = CollectorRegistry()
        Info("gsvis_build", "Versions of what serves.", registry=r).info(_build())
        self.clients = Gauge(r, "gsvis_clients", "Clients streaming now.")
        self.opened = Counter(r, "gsvis_clients_opened_total", "Clients that began to stream.", "scene")
        self.closed = Counter(r, "gsvis_clients_closed_total", "Clients that left or were disconnected.", "reason")
        self.refused = Counter(r, "gsvis_refused_total", "Requests that were refused.", "reason")
        self.cut = Counter(r, "gsvis_cut_total", "Connections that were cut.", "reason")
        self.accept_failures = Counter(r, "gsvis_accept_failures_total", "Connections not accepted.", "error")
        self.sent = SentMetrics.in_registry(r)
        self.received = Counter(r, "gsvis_received_messages_total", "Messages of clients.", "kind")
        self.skipped = Counter(r, "gsvis_skipped_poses_total", "Poses that were ignored.")
        self.parts = Counter(r, "gsvis_parts_requests_total", "Requests for files of packages.", "status")
        self.parts_bytes = Counter(r, "gsvis_parts_bytes_total", "Bytes of files of packages.")
        self.scenes = SceneMetrics.in_registry(r)
        self.planning = Histogram(
            r, "gsvis_planning_seconds", "Seconds from the decision to send to the encoded batch."
        )
        self.late = Histogram(r, "gsvis_late_seconds", "Seconds by which the event loop runs late.")
        ProcessCollector(registry=r)

    def text(self) -> str:
        """Return the text that `/metrics` answers."""
        return prometheus_client.generate_latest(_WithoutCreated(self.registry)).decode()


class _WithoutCreated(CollectorRegistry):
    """A registry without the creation time of each series, which would double the page.

    The library can switch these times off only for a whole process.
    """

    def __init__(self, registry: CollectorRegistry) -> None:
        super().__init__()
        self._of = registry

    def collect(self) -> Iterator[Metric]:
        for family in self._of.collect():
            family.samples = [sample for sample in family.samples if not sample.name.endswith("_created")]
            yield family


def _sample(metric: Collector, name: str, labels: dict[str, str]) -> float:
    """Return the value of one series; 0 if there is none."""
    samples = (sample for family in metric.collect() for sample in family.samples)
    return next((sample.value for sample in samples if sample.name == name and sample.labels == labels), 0.0)


def _build() -> dict[str, str]:
    """Return the versions of Python, gsvis and the libraries that serve."""
    found = {"python": platform.python_version()}
    for name in ("gsvis", "uvicorn", "websockets"):
        try:
            found["version" if name == "gsvis" else name] = version(name)
        except PackageNotFoundError:  # run from its sources
            found["version" if name == "gsvis" else name] = "unknown"
    return found
