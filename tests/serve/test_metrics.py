"""What Prometheus reads is well formed and adds up; log lines are one line whatever is in them."""

from __future__ import annotations

import logging
import re
from pathlib import Path

import prometheus_client
import pytest
from hypothesis import given
from hypothesis import strategies as st
from prometheus_client import CollectorRegistry
from prometheus_client.parser import text_string_to_metric_families

from gsvis.serve._log import EventLog, line_of
from gsvis.serve.metrics import Histogram, Metrics

SAMPLE = re.compile(r'([a-z_]+)(\{([a-z]+="(\\.|[^"\\\n])*",?)+\})? (\d+(\.\d+)?(e[+-]\d+)?)')


def test_every_line_is_a_sample_or_says_what_one_is() -> None:
    metrics = Metrics()
    metrics.opened.add(of='a "quoted"\nname\\')
    metrics.clients.set(3)
    metrics.late.observe(0.03)
    lines = metrics.text().splitlines()
    for line in lines:
        assert line.startswith(("# HELP gsvis_", "# TYPE gsvis_", "# HELP process_", "# TYPE process_")) or (
            SAMPLE.fullmatch(line)
        ), line
    assert "gsvis_clients 3.0" in lines
    assert len(lines) == len(set(lines))
    names = [line.split()[2] for line in lines if line.startswith("# TYPE gsvis_")]
    assert all(name.endswith(("_total", "_seconds", "_clients", "_info")) for name in names)
    assert not any("_created" in line for line in lines)


def test_a_parser_of_the_field_reads_what_was_counted() -> None:
    metrics = Metrics()
    name = 'a "quoted"\nname\\'
    metrics.opened.add(2, of=name)
    metrics.sent_bytes.add(1e6)
    samples = {
        (sample.name, *sample.labels.values()): sample.value
        for family in text_string_to_metric_families(metrics.text())
        for sample in family.samples
    }
    assert samples["gsvis_clients_opened_total", name] == metrics.opened.value(name) == 2
    assert samples["gsvis_sent_bytes_total",] == metrics.sent_bytes.value() == 1e6
    assert samples["gsvis_clients",] == 0
    assert metrics.opened.value("another") == 0


def test_it_says_which_version_serves_and_what_the_process_takes() -> None:
    found = {family.name: family for family in text_string_to_metric_families(Metrics().text())}
    (build,) = found["gsvis_build_info"].samples
    assert build.value == 1
    assert set(build.labels) == {"version", "python", "uvicorn", "websockets"}
    if Path("/proc/self/stat").exists():
        assert found["process_resident_memory_bytes"].samples[0].value > 1e6
        assert found["process_open_fds"].samples[0].value >= 3


def test_two_servers_of_a_process_count_apart() -> None:
    first, second = Metrics(), Metrics()
    first.batches.add()
    first.clients.add(2)
    assert (second.batches.value(), second.clients.value()) == (0, 0)
    assert "gsvis_batches_total" not in prometheus_client.generate_latest().decode()  # of the whole process


@given(st.lists(st.floats(0, 20), max_size=30))
def test_a_histogram_counts_everything_once(values: list[float]) -> None:
    registry = CollectorRegistry()
    histogram = Histogram(registry, "h", "about")
    for value in values:
        histogram.observe(value)
    family, *_ = text_string_to_metric_families(prometheus_client.generate_latest(registry).decode())
    found = [int(sample.value) for sample in family.samples if sample.name == "h_bucket"]
    assert found == sorted(found)
    assert found[-1] == histogram.count == len(values)
    assert histogram.sum == pytest.approx(sum(values))
    for bound, below in zip(histogram.bounds, found, strict=False):
        assert below == sum(value <= bound for value in values)


@given(st.text(max_size=400))
def test_a_line_is_one_line(text: str) -> None:
    line = line_of("event", why=text, none=None, count=3)
    assert len(line.splitlines()) == 1
    assert line.isprintable()
    assert line.endswith("count=3")
    assert len(line) < 4000


def test_a_flood_of_lines_is_cut_and_counted(caplog: pytest.LogCaptureFixture) -> None:
    now = [0.0]
    log = EventLog(per_s=1.0, clock=lambda: now[0])
    with caplog.at_level(logging.INFO, logger="gsvis.serve"):
        for _ in range(50):
            log("again")
        log("other")
        now[0] = 1.0
        log("again")
    assert [record.getMessage() for record in caplog.records] == ["again"] * 10 + ["other", "again left_out=40"]
