"""How long transfers took, by the sender's own clock: what was sent when, and when it was acknowledged.

Messages follow each other on one ordered link. The time of one is from when the link was free for it: when it was sent,
or when the one before had left; both are seen a round trip later.
"""

from __future__ import annotations

from collections import deque

import numpy as np

__all__ = ["LinkMeter"]

_SMALL = 4096  # bytes of a message whose way takes about a round trip
_LEAST = 2048  # bytes of transfers whose duration says something of a link


class LinkMeter:
    """Messages under way and the times of those that have arrived.

    Attributes:
        outstanding: Bytes sent and not acknowledged.
        round_trip: The smallest seen of small messages, seconds; 0 before there was one.
        last: Number of the last message sent; -1 before the first.
    """

    def __init__(self) -> None:
        self.outstanding = 0
        self.last = -1
        self._round_trip = np.inf
        self._sent: deque[tuple[int, float, int]] = deque()
        self._acknowledged = -np.inf  # when the last acknowledgement came
        self._bytes, self._seconds = 0, 0.0

    @property
    def round_trip(self) -> float:
        """Seconds."""
        return float(self._round_trip) if np.isfinite(self._round_trip) else 0.0

    def on_sent(self, t: float, sequence: int, nbytes: int) -> None:
        """A message is on its way."""
        self._sent.append((sequence, t, nbytes))
        self.outstanding += nbytes
        self.last = sequence

    def on_ack(self, t: float, sequence: int) -> tuple[int, float] | None:
        """All up to a message have arrived.

        Returns:
            Bytes and seconds of a transfer that says something of the link; None where there is none. Acknowledgements
            that come twice say nothing.

        Raises:
            ValueError: If no such message was sent.
        """
        if sequence > self.last:
            raise ValueError(f"sequence: expected at most {self.last}, got {sequence}")
        size, first = 0, np.inf
        while self._sent and self._sent[0][0] <= sequence:
            _, sent, nbytes = self._sent.popleft()
            size, first = size + nbytes, min(first, sent)
        if size == 0:
            return None
        self.outstanding -= size
        if size <= _SMALL:
            self._round_trip = min(self._round_trip, max(t - first, 0.0))
        free = max(first + self.round_trip, self._acknowledged)
        self._acknowledged = t
        self._bytes, self._seconds = self._bytes + size, self._seconds + max(t - free, 0.0)
        if self._bytes < _LEAST or self._seconds <= 0.0:
            return None
        found = self._bytes, max(self._seconds, 1e-4)
        self._bytes, self._seconds = 0, 0.0
        return found
