"""What Prometheus reads is well formed and adds up; log lines are one line whatever is in them."""

from __future__ import annotations

import logging
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsvis.serve._log import EventLog, line_of
from gsvis.serve.metrics import Histogram, Metrics

SAMPLE = re.compile(r'[a-z_]+(\{[a-z]+="(\\.|[^"\\\n])*"\})? (\d+(\.\d+)?(e[+-]\d+)?)')


def test_every_line_is_a_sample_or_says_what_one_is() -> None:
    metrics = Metrics()
    metrics.opened.add(of='a "quoted"\nname\\')
    metrics.clients.set(3)
    metrics.late.observe(0.03)
    lines = metrics.text().splitlines()
    for line in lines:
        assert line.startswith(("# HELP gsvis_", "# TYPE gsvis_")) or SAMPLE.fullmatch(line), line
    assert "gsvis_clients 3" in lines
    assert len(lines) == len(set(lines))
    names = [line.split()[2] for line in lines if line.startswith("# TYPE")]
    assert all(name.endswith(("_total", "_seconds", "_clients")) for name in names)


@given(st.lists(st.floats(0, 20), max_size=30))
def test_a_histogram_counts_everything_once(values: list[float]) -> None:
    histogram = Histogram("h", "about")
    for value in values:
        histogram.observe(value)
    found = [int(line.split()[1]) for line in histogram.lines() if "_bucket" in line]
    assert found == sorted(found)
    assert found[-1] == histogram.count == len(values)
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
