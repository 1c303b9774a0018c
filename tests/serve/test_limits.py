"""Rates are held over any span of time, and a limit that is none is refused."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsvis.serve.limits import Limits, RateBucket


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
