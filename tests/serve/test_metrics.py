"""What Prometheus reads is well formed and adds up; log lines are one line whatever is in them."""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import prometheus_client
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from prometheus_client import CollectorRegistry
from prometheus_client.parser import text_string_to_metric_families

from gsvis.serve import JsonLines, TextLines
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
    assert all(name.endswith(("_total", "_seconds", "_clients", "_info", "_bytes", "_scenes")) for name in names)
    assert not any("_created" in line for line in lines)


def test_a_parser_of_the_field_reads_what_was_counted() -> None:
    metrics = Metrics()
    name = 'a "quoted"\nname\\'
    metrics.opened.add(2, of=name)
    metrics.sent.bytes.add(1e6)
    samples = {
        (sample.name, *sample.labels.values()): sample.value
        for family in text_string_to_metric_families(metrics.text())
        for sample in family.samples
    }
    assert samples["gsvis_clients_opened_total", name] == metrics.opened.value(name) == 2
    assert samples["gsvis_sent_bytes_total",] == metrics.sent.bytes.value() == 1e6
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
    first.sent.batches.add()
    first.clients.add(2)
    assert (second.sent.batches.value(), second.clients.value()) == (0, 0)
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


FACTS = st.dictionaries(
    st.sampled_from(["why", "client", "reason", "rate"]),
    st.one_of(st.none(), st.text(max_size=400), st.integers(), st.floats(), st.booleans(), st.binary(max_size=9)),
)


def records_of(say: Callable[[EventLog], None]) -> list[logging.LogRecord]:
    """What a log writes."""
    found: list[logging.LogRecord] = []

    class Kept(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            found.append(record)

    logger, kept = logging.getLogger("gsvis.serve"), Kept()
    before = logger.level
    logger.addHandler(kept)
    logger.setLevel(logging.INFO)
    try:
        say(EventLog())
    finally:
        logger.removeHandler(kept)
        logger.setLevel(before)
    return found


@given(FACTS)
@example({"why": 1.7976e308})  # rounds to more than a float holds
def test_an_object_a_line_with_the_facts_as_keys(facts: dict[str, object]) -> None:
    (record,) = records_of(lambda log: log("closed", logging.WARNING, **facts))
    line = JsonLines().format(record)
    assert line.isascii()
    assert line.isprintable()
    found = json.loads(line, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    assert (found.pop("level"), found.pop("event")) == ("WARNING", "closed")
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z", found.pop("time"))
    assert set(found) == {key for key, value in facts.items() if value is not None}
    for key, value in found.items():
        if isinstance(facts[key], bool | int):
            assert value == facts[key]
        elif isinstance(facts[key], str):
            assert str(facts[key]).startswith(value.removesuffix("...")[:300])
            assert len(value) <= 303
    text = TextLines().format(record)
    assert text.endswith(line_of("closed", **facts))
    assert text[:23] == json.loads(line)["time"][:23]


def test_lines_of_others_and_tracebacks_are_objects_too() -> None:
    try:
        raise ValueError("two\nlines")
    except ValueError as error:
        given = (type(error), error, error.__traceback__)
    record = logging.LogRecord("uvicorn.error", logging.ERROR, __file__, 1, "it %s", ("failed",), given)
    found = json.loads(JsonLines().format(record))
    assert (found["event"], found["logger"], found["message"]) == ("log", "uvicorn.error", "it failed")
    assert "ValueError: two" in found["traceback"]


def test_left_out_lines_are_counted_in_the_object() -> None:
    def say(log: EventLog) -> None:
        now = [0.0]
        few = EventLog(per_s=1.0, clock=lambda: now[0])
        for _ in range(12):
            few("again")
        now[0] = 1.0
        few("again", rate=float("nan"), scenes=np.int64(3))

    *_, last = records_of(say)
    found = json.loads(JsonLines().format(last))
    assert (found["left_out"], found["rate"], found["scenes"]) == (2, "nan", 3)
