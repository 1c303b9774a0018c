"""The link: bytes arrive when a rate and a distance say so."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsvis.abr import BandwidthTrace
from gsvis.simulate import Link, Pipe


def test_a_steady_link_is_a_straight_line() -> None:
    pipe = Pipe(Link(BandwidthTrace.constant(8.0), round_trip=0.1))  # 1 MB a second
    assert pipe.send(0.0, 500_000) == pytest.approx(0.55)
    assert pipe.send(0.1, 500_000) == pytest.approx(1.05)  # behind the one before
    assert pipe.send(3.0, 0) == pytest.approx(3.05)  # idle in between


def test_what_a_dead_link_is_given_never_arrives() -> None:
    pipe = Pipe(Link(BandwidthTrace.constant(0.0)))
    assert pipe.send(0.0, 10) == np.inf
    assert pipe.send(1.0, 10) == np.inf


@given(
    st.lists(st.tuples(st.floats(0.0, 1.0), st.integers(0, 200_000)), min_size=1, max_size=20),
    st.lists(st.floats(0.0, 20.0), min_size=1, max_size=6).filter(lambda rates: sum(rates) > 0.1),
)
def test_no_byte_overtakes_and_none_is_faster_than_the_link(sends: list[tuple[float, int]], rates: list[float]) -> None:
    trace = BandwidthTrace(np.arange(1.0, len(rates) + 1.0), np.array(rates))
    pipe, t, total, before = Pipe(Link(trace, 0.02)), 0.0, 0, -np.inf
    for wait, size in sends:
        t, total = t + wait, total + size
        arrival = pipe.send(t, size)
        assert arrival >= max(before, t + 0.01)
        assert total <= trace.bytes_between(0.0, arrival - 0.01) * (1 + 1e-9) + 1e-3
        before = arrival


def test_a_link_begun_later_goes_on_as_it_was() -> None:
    link = Link(BandwidthTrace([1.0, 2.0], [8.0, 80.0]))
    assert Pipe(link.from_time(1.0)).send(0.0, 5_000_000) == pytest.approx(0.52)


def test_a_negative_round_trip_is_refused() -> None:
    with pytest.raises(ValueError, match="round_trip: expected finite seconds"):
        Link(BandwidthTrace.constant(1.0), -0.1)
