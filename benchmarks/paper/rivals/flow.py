"""Limit what a rival may have in flight: a number of files, as browsers do, or a window of the link, as our sessions.

Seconds and bytes. A sender asks `ready` before it sends another piece. Acknowledgements travel back to the sender, so
that a piece that was waited for costs a round trip.
"""

from __future__ import annotations

from collections import deque
from typing import Protocol

from gsvis import _check
from gsvis.abr.config import AbrConfig
from gsvis.abr.estimate import estimator
from gsvis.stream.meter import LinkMeter

__all__ = ["Files", "Flow", "Window"]

_LEAST = 4096.0  # bytes of a message at least, as in `gsvis.stream.session`


class Flow(Protocol):
    """Interface of a limit on what is in flight."""

    def ready(self) -> bool:
        """Return whether another piece may be sent now."""
        ...

    def on_sent(self, t: float, parcels: list[tuple[int, int]]) -> None:
        """Record a piece that was sent at time t: numbers and bytes of its parcels."""
        ...

    def on_ack(self, t: float, sequence: int) -> None:
        """Record that all parcels up to this one have arrived."""
        ...


class Files:
    """At most so many files in flight; the next is requested when one is complete.

    Args:
        most: Number of files.
    """

    def __init__(self, most: int) -> None:
        self.most = _check.positive_int("most", most)
        self._last: deque[int] = deque()

    def ready(self) -> bool:
        """Return whether another file may be requested; see `Flow`."""
        return len(self._last) < self.most

    def on_sent(self, t: float, parcels: list[tuple[int, int]]) -> None:
        """Record a file; see `Flow`."""
        self._last.append(parcels[-1][0])

    def on_ack(self, t: float, sequence: int) -> None:
        """Record what is complete; see `Flow`."""
        while self._last and self._last[0] <= sequence:
            self._last.popleft()


class Window:
    """As many bytes in flight as our own sessions allow: a window of the measured rate and a round trip.

    Args:
        config: Window, piece, estimator and start rate of a session; None means `AbrConfig()`.
    """

    def __init__(self, config: AbrConfig | None = None) -> None:
        self.config = config or AbrConfig()
        self._meter = LinkMeter()
        self._rate = estimator(self.config.estimator, self.config.start_rate)

    def ready(self) -> bool:
        """Return whether half a message fits; see `Flow`. Always true with nothing in flight."""
        rate = self._rate.estimate()
        waiting = self._meter.outstanding
        free = rate * (self.config.window + self._meter.round_trip) - waiting
        return waiting == 0 or free >= 0.5 * max(rate * self.config.piece, _LEAST)

    def on_sent(self, t: float, parcels: list[tuple[int, int]]) -> None:
        """Record a piece; see `Flow`."""
        for sequence, nbytes in parcels:
            self._meter.on_sent(t, sequence, nbytes)

    def on_ack(self, t: float, sequence: int) -> None:
        """Measure the link; see `Flow`."""
        if sequence <= self._meter.last:
            transfer = self._meter.on_ack(t, sequence)
            if transfer is not None:
                self._rate.observe(*transfer)
