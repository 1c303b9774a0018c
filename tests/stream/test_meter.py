"""The sender's measure of a link: a steady link is found, whatever its delay, from messages and acknowledgements."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsvis.stream.meter import LinkMeter


@pytest.mark.parametrize("round_trip", [0.0, 0.02, 0.2])
@pytest.mark.parametrize("rate", [125e3, 1.25e6, 12.5e6])
@pytest.mark.parametrize("load", [0.3, 1.0, 3.0])
def test_a_steady_link_is_found(rate: float, round_trip: float, load: float) -> None:
    """Messages every 100 ms that keep the link idle, just busy, or always behind."""
    meter, free, events, found = LinkMeter(), 0.0, [], []
    for k in range(30):
        size = 800 if k == 0 else int(rate * 0.1 * load)
        free = max(free, 0.1 * k) + size / rate
        events += [(0.1 * k, 0, k, size), (free + round_trip, 1, k, size)]
    for t, kind, number, size in sorted(events):
        if kind == 0:
            meter.on_sent(t, number, size)
        elif (transfer := meter.on_ack(t, number)) is not None:
            found.append(transfer)
    assert meter.outstanding == 0
    assert round_trip <= meter.round_trip <= round_trip + 800 / rate + 1e-9
    rates = [nbytes / seconds for nbytes, seconds in found[1:]]
    assert np.median(rates) == pytest.approx(rate, rel=0.08 if load < 1 and rate > 2e5 else 0.3)
    assert np.median(rates) >= 0.99 * rate


@given(st.lists(st.tuples(st.booleans(), st.floats(0, 1), st.integers(1, 100_000)), max_size=40))
def test_what_is_under_way_is_what_was_sent_and_not_acknowledged(steps: list[tuple[bool, float, int]]) -> None:
    meter, t, sent, known = LinkMeter(), 0.0, [], -1
    for sends, wait, size in steps:
        t += wait
        if sends or not sent:
            meter.on_sent(t, len(sent), size)
            sent.append(size)
        else:
            number = size % len(sent)
            known = max(known, number)
            transfer = meter.on_ack(t, number)
            assert transfer is None or (transfer[0] > 0 and transfer[1] > 0)
        assert meter.outstanding == sum(sent[known + 1 :])
        assert meter.round_trip >= 0.0


def test_what_was_never_sent_cannot_be_acknowledged() -> None:
    meter = LinkMeter()
    with pytest.raises(ValueError, match=r"^sequence: expected at most -1, got 0"):
        meter.on_ack(0.0, 0)
    meter.on_sent(0.0, 0, 100)
    assert meter.on_ack(0.1, 0) is None  # too little to say something of a link
    assert meter.on_ack(0.2, 0) is None
    with pytest.raises(ValueError, match=r"^sequence"):
        meter.on_ack(0.0, 1)


@pytest.mark.parametrize("small", range(3, 40, 6))
def test_a_small_message_behind_others_does_not_pass_for_the_round_trip(small: int) -> None:
    """The sender keeps 0.3 s of a link of 1 Mbit/s in flight, and one message is small: the rate stays what it is."""
    meter, rate, round_trip = LinkMeter(), 125e3, 0.04
    free, sent, acks, found = 0.0, 0, [], []
    for _ in range(100):
        t = acks.pop(0) if acks else 0.0
        if sent and (transfer := meter.on_ack(t, sent - len(acks) - 1)) is not None:
            found.append(transfer)
        while meter.outstanding < 0.3 * rate:
            size = 2000 if sent == small else 9000
            meter.on_sent(t, sent, size)
            free = max(free, t) + size / rate
            acks.append(free + round_trip)
            sent += 1
    assert meter.round_trip == 0.0
    assert max(nbytes / seconds for nbytes, seconds in found) <= rate * (1 + 1e-9)
