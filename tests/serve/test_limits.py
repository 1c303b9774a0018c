"""Rates are held over any span of time, and a limit that is none is refused."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsvis.serve.limits import Limits, RateBucket, Seats


@given(st.lists(st.floats(0, 3), min_size=1, max_size=60), st.floats(0.5, 50), st.integers(1, 20))
def test_no_span_holds_more_than_its_length_and_the_burst_allow(waits: list[float], rate: float, burst: int) -> None:
    bucket, t, taken = RateBucket(rate, burst), 0.0, []
    for wait in waits:
        t += wait
        if bucket.take(t):
            taken.append(t)
    for k, first in enumerate(taken):
        for m in range(k, len(taken)):
            assert m - k + 1 <= burst + rate * (taken[m] - first) + 1e-6


def test_a_steady_rate_within_the_limit_is_never_refused() -> None:
    bucket = RateBucket(10.0, 3)
    assert all(bucket.take(0.1 * k + 1e-9) for k in range(200))


@pytest.mark.parametrize(
    "name", ["handshake_s", "keep_alive_s", "idle_s", "stall_s", "tick_s", "poses_per_s", "messages_per_s"]
)
@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
def test_a_limit_has_to_be_one(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=name):
        Limits(**{name: value})


def test_counts_have_to_be_counts() -> None:
    for wrong in ({"connections": 0}, {"waiting": 0}, {"per_address": 0}, {"batch_bytes": 0}, {"message_bytes": 3}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            Limits(**wrong)


@dataclass
class Silent:
    """A viewer with a seat."""

    silent_s: float
    gave_way: bool = False

    def give_way(self) -> None:
        self.gave_way = True


def test_half_of_the_seats_are_for_one_address_by_default() -> None:
    assert [Limits(connections=count).most_per_address for count in (100, 30, 3)] == [50, 15, 8]
    assert Limits(connections=100, per_address=7).most_per_address == 7


@pytest.mark.parametrize("full", ["address-full", "too-many"])
def test_a_silent_seat_goes_to_a_viewer_of_its_address_and_to_nobody_else(full: str) -> None:
    seats = Seats(Limits(connections=9 if full == "address-full" else 3, per_address=3))
    seated = [Silent(4.0), Silent(9.0), Silent(7.0)]
    assert [seats.take("a", viewer) for viewer in seated] == [""] * 3
    if full == "too-many":
        assert seats.take("b", Silent(0.0)) == "too-many"
    newcomers = [Silent(0.0) for _ in range(3)]
    assert [seats.why_not("a"), seats.take("a", newcomers[0]), seats.take("a", newcomers[1])] == ["", "", ""]
    assert [viewer.gave_way for viewer in seated] == [False, True, True]
    assert [seats.why_not("a"), seats.take("a", newcomers[2])] == [full, full]
    assert seats.taken == 3
    seats.leave("a", seated[1])  # which has lost its seat already
    assert seats.taken == 3
    seats.leave("a", seated[0])
    assert (seats.taken, seats.take("a", newcomers[2])) == (2, "")


def test_nobody_gives_way_while_there_is_a_seat_or_at_five_seconds() -> None:
    seats = Seats(Limits(connections=9, per_address=2))
    seated = [Silent(99.0), Silent(5.0)]
    assert [seats.take("a", viewer) for viewer in seated] == ["", ""]
    assert not any(viewer.gave_way for viewer in seated)
    seated[0].silent_s = 5.0
    assert seats.take("a", Silent(0.0)) == "address-full"
