"""Recorded links and what estimates them: exact sums, inverses, and means with known answers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsvis.abr.estimate import ESTIMATORS, Ewma, HarmonicMean, RobustMpc, estimator
from gsvis.abr.traces import BandwidthTrace, load_trace
from gsvis.errors import FormatError


def some_link(seed: int, *, silent: bool = True) -> BandwidthTrace:
    rng = np.random.default_rng(seed)
    rates = rng.uniform(0.1, 50, int(rng.integers(1, 8)))
    if silent:
        rates[rng.random(len(rates)) < 0.4] = 0.0
        rates[0] = max(rates[0], 0.5)
    return BandwidthTrace(np.cumsum(rng.uniform(0.05, 3, len(rates))), rng.permutation(rates))


def slow_bytes(link: BandwidthTrace, start: float, stop: float) -> float:
    """By walking from edge to edge."""
    total, t = 0.0, start
    while t < stop:
        within = t % link.period
        k = int(np.searchsorted(link.times, within, side="right"))
        step = min(link.times[k] - within, stop - t) if k < len(link.times) else stop - t
        step = max(step, 1e-9)
        total += step * link.mbit_per_s[min(k, len(link.times) - 1)] * 125_000
        t += step
    return total


@given(st.integers(0, 10_000), st.floats(0, 30), st.floats(0, 30))
def test_bytes_between_is_what_walking_along_the_trace_gives(seed: int, start: float, length: float) -> None:
    link = some_link(seed)
    assert link.bytes_between(start, start + length) == pytest.approx(slow_bytes(link, start, start + length), abs=5.0)


@given(st.integers(0, 10_000), st.floats(0, 30), st.floats(0.01, 10), st.floats(0.01, 10))
def test_bytes_add_up_and_come_round(seed: int, start: float, first: float, second: float) -> None:
    link = some_link(seed)
    middle, stop = start + first, start + first + second
    parts = link.bytes_between(start, middle) + link.bytes_between(middle, stop)
    assert parts == pytest.approx(link.bytes_between(start, stop), abs=1e-3)
    assert link.bytes_between(start, start + link.period) == pytest.approx(link.mean * 125_000 * link.period)
    later = link.from_time(start)
    assert later.bytes_between(0, first) == pytest.approx(link.bytes_between(start, middle), rel=1e-6, abs=1.0)


@given(st.integers(0, 10_000), st.floats(0, 30), st.floats(1, 3e7))
def test_time_to_send_is_the_first_moment_at_which_all_has_gone(seed: int, start: float, size: float) -> None:
    link = some_link(seed)
    seconds = link.time_to_send(size, start)
    assert link.bytes_between(start, start + seconds) == pytest.approx(size, abs=1.0 + 1e-9 * size)
    if seconds > 1e-3:
        assert link.bytes_between(start, start + seconds - 1e-3) < size


def test_known_links() -> None:
    steady = BandwidthTrace.constant(8.0)
    assert steady.bytes_between(0.25, 7.75) == 7.5e6
    assert steady.time_to_send(3e6, 12.3) == pytest.approx(3.0)
    silent = BandwidthTrace([1.0, 2.0], [8.0, 0.0])
    assert silent.time_to_send(1e6, 0.0) == 1.0
    assert silent.time_to_send(2e6, 0.0) == 3.0
    assert silent.time_to_send(1.0, 1.5) == pytest.approx(0.5 + 1e-6)
    assert silent.rate_at(0.5) == 8.0
    assert silent.rate_at(3.5) == 0.0
    assert BandwidthTrace([1.0], [0.0]).time_to_send(1.0, 0.0) == np.inf
    assert BandwidthTrace([1.0], [0.0]).time_to_send(0.0, 0.0) == 0.0
    assert steady.scaled(0.5).mean == 4.0


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: BandwidthTrace([], []), "times"),
        (lambda: BandwidthTrace([0.0, 1.0], [1.0, 1.0]), "times"),
        (lambda: BandwidthTrace([1.0], [-1.0]), "mbit_per_s"),
        (lambda: BandwidthTrace.constant(1.0).bytes_between(2.0, 1.0), "stop"),
        (lambda: BandwidthTrace.constant(1.0).bytes_between(-1.0, 1.0), "t"),
        (lambda: BandwidthTrace.constant(1.0).time_to_send(np.nan, 1.0), "size"),
        (lambda: Ewma(fast=0.0), "fast"),
        (lambda: Ewma().observe(1.0, 0.0), "seconds"),
        (lambda: HarmonicMean(last=0), "last"),
        (lambda: estimator("best"), "name"),
    ],
)
def test_wrong_arguments_are_named(make, message: str) -> None:
    with pytest.raises(ValueError, match=f"^{message}"):
        make()


def test_text_traces_are_read(tmp_path: Path) -> None:
    path = tmp_path / "link"
    path.write_text("0.0\t5.0\n1.0 2.0\n\n3.5\t4.0\n")
    link = load_trace(path)
    assert link.times.tolist() == [1.0, 3.5]
    assert link.mbit_per_s.tolist() == [2.0, 4.0]
    assert link.name == "link"


def test_5g_logs_are_read(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text("Timestamp,DL_bitrate,State\na,1000,D\na,0,I\n")
    link = load_trace(path)
    assert link.times.tolist() == [1.0, 2.0]
    assert link.mbit_per_s.tolist() == [1.0, 0.0]


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("link", "", "at least one line"),
        ("link", "0 1\n", "at least one line"),
        ("link", "1 2\n1 3\n", "line 2: expected seconds after 1"),
        ("link", "1 2 3\n", "line 1: expected two numbers"),
        ("link", "1 x\n", "line 1: expected two numbers"),
        ("link", "1 nan\n", "line 1: expected Mbit/s"),
        ("link", "nan 1\n", "line 1: expected seconds"),
        ("link", "1 -2\n", "line 1: expected Mbit/s"),
        ("log.csv", "a,b\n1,2\n", "column DL_bitrate"),
        ("log.csv", "DL_bitrate\n", "at least one row"),
        ("log.csv", "DL_bitrate\n-1\n", "kbit/s"),
        ("log.csv", "DL_bitrate\n-\n", "a finite number"),
    ],
)
def test_bad_traces_are_refused_with_their_place(tmp_path: Path, name: str, text: str, message: str) -> None:
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(FormatError, match=message):
        load_trace(path)
    with pytest.raises(FileNotFoundError):
        load_trace(tmp_path / "none")


@given(st.sampled_from(ESTIMATORS), st.floats(1e3, 1e8), st.floats(0.01, 5))
def test_a_steady_link_is_estimated_right_from_the_first_transfer(name: str, rate: float, seconds: float) -> None:
    found = estimator(name, start=123.0)
    assert found.estimate() == 123.0
    for _ in range(8):
        found.observe(rate * seconds, seconds)
        assert found.estimate() == pytest.approx(rate)


def test_known_means() -> None:
    harmonic, robust, ewma = HarmonicMean(2), RobustMpc(3), Ewma(1.0, 4.0)
    for rate in (100.0, 200.0, 400.0):
        harmonic.observe(rate, 1.0)
        robust.observe(rate, 1.0)
        ewma.observe(rate, 1.0)
    assert harmonic.estimate() == pytest.approx(2 / (1 / 200 + 1 / 400))
    mean = 3 / (1 / 100 + 1 / 200 + 1 / 400)
    before = 2 / (1 / 100 + 1 / 200)
    assert robust.estimate() == pytest.approx(mean / (1 + max(0.5, (400 - before) / 400)))
    kept = 0.5**0.25
    slow = (1 - kept) * (100 * kept**2 + 200 * kept + 400) / (1 - kept**3)
    assert ewma.estimate() == pytest.approx(slow)  # rising: the slow one is the lower


@given(st.sampled_from(ESTIMATORS), st.lists(st.tuples(st.floats(0, 1e7), st.floats(1e-3, 10)), max_size=20))
def test_estimates_lie_within_what_was_seen_or_below(name: str, transfers: list[tuple[float, float]]) -> None:
    found = estimator(name)
    for sent, seconds in transfers:
        found.observe(sent, seconds)
        assert 0.0 < found.estimate() < np.inf
    if transfers:
        assert found.estimate() <= max(1.0, *(sent / seconds for sent, seconds in transfers)) * (1 + 1e-9)


@pytest.mark.realdata
def test_recorded_links_are_read(realdata: Path) -> None:
    traces = realdata / "traces"
    medians = {}
    for folder in ("cooked_3gp", "traces_oboe", "5g_download"):
        files = sorted(p for p in (traces / folder).rglob("*") if p.is_file() and not p.name.startswith("."))[::5]
        assert files
        links = [load_trace(file) for file in files]
        assert all(link.mean > 0 and link.period > 5 for link in links)
        medians[folder] = float(np.median([link.mean for link in links]))
        for link in links:
            assert link.bytes_between(0.0, link.time_to_send(3e6, 0.0)) == pytest.approx(3e6, abs=1.0)
    assert 0.5 < medians["cooked_3gp"] < 6
    assert 0.5 < medians["traces_oboe"] < 6
    assert medians["5g_download"] > 10
