"""Measure how long transfers take, by the sender's clock: from the times of messages and their acknowledgements.

Messages follow each other on one ordered link. The transfer of a message starts when the link is free for it: when it
is sent, or when the message before it has left. The sender sees start and end one round trip later. The round trip is
measured with messages that have almost nothing in flight before them, as all others wait in the queue. If the round
trip is overestimated, transfers look too short and the link too fast.
"""

from __future__ import annotations

from collections import deque

import numpy as np

__all__ = ["LinkMeter"]

_SMALL = 4096  # most bytes in flight for a message that measures the round trip
_LEAST = 2048  # least bytes of transfers whose duration measures the link


class LinkMeter:
    """Measure transfers on one link, and count the bytes in flight.

    Attributes:
        outstanding: Bytes sent and not acknowledged.
        round_trip: Seconds, the shortest round trip of a small transfer on an idle link; 0 before the first.
        last: Number of the last message sent; -1 before the first.
    """

    def __init__(self) -> None:
        self.outstanding = 0
        self.last = -1
        self._round_trip = np.inf
        self._sent: deque[tuple[int, float, int, int]] = deque()  # number, time, bytes, bytes in flight with it
        self._acknowledged = -np.inf  # when the last acknowledgement came
        self._bytes = 0
        self._seconds = 0.0

    @property
    def round_trip(self) -> float:
        """Seconds, the shortest round trip of a small transfer on an idle link; 0 before the first."""
        return float(self._round_trip) if np.isfinite(self._round_trip) else 0.0

    def on_sent(self, t: float, sequence: int, nbytes: int) -> None:
        """Record that a message was sent.

        Args:
            t: Seconds.
            sequence: Number of the message.
            nbytes: Bytes of the message.
        """
        self.outstanding += nbytes
        self._sent.append((sequence, t, nbytes, self.outstanding))
        self.last = sequence

    def on_ack(self, t: float, sequence: int) -> tuple[int, float] | None:
        """Record that all messages up to this one have arrived.

        Args:
            t: Seconds.
            sequence: Number of the last message that arrived.

        Returns:
            Bytes and seconds of a transfer; None for a repeated acknowledgement, and while too few bytes have arrived
            for a measurement.

        Raises:
            ValueError: If no such message was sent.
        """
        if sequence > self.last:
            raise ValueError(f"sequence: expected at most {self.last}, got {sequence}")
        size = 0
        first = np.inf
        flight = 0
        while self._sent and self._sent[0][0] <= sequence:
            _, sent, nbytes, flight = self._sent.popleft()
            size = size + nbytes
            first = min(first, sent)
        if size == 0:
            return None
        self.outstanding -= size
        if flight <= _SMALL:
            self._round_trip = min(self._round_trip, max(t - first, 0.0))
        free = max(first + self.round_trip, self._acknowledged)
        self._acknowledged = t
        self._bytes, self._seconds = self._bytes + size, self._seconds + max(t - free, 0.0)
        if self._bytes < _LEAST or self._seconds <= 0.0:
            return None
        found = self._bytes, max(self._seconds, 1e-4)
        self._bytes = 0
        self._seconds = 0.0
        return found
