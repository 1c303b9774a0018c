"""A link between a server and one client: bytes go one after the other at a recorded rate, and take time to travel.

Seconds and bytes. The way back carries poses and acknowledgements, which are small: it has a delay and no rate.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsvis.abr.traces import BandwidthTrace

__all__ = ["Link", "Pipe"]


@dataclass(frozen=True)
class Link:
    """What lies between the two.

    Attributes:
        trace: Rate from the server to the client.
        round_trip: Seconds that a byte needs there and back on an idle link; half of them each way.
    """

    trace: BandwidthTrace
    round_trip: float = 0.04

    def __post_init__(self) -> None:
        if not (np.isfinite(self.round_trip) and self.round_trip >= 0):
            raise ValueError(f"round_trip: expected finite seconds >= 0, got {self.round_trip!r}")

    @property
    def delay(self) -> float:
        """Seconds each way."""
        return 0.5 * self.round_trip

    def from_time(self, start: float) -> Link:
        """The same link, begun later."""
        return Link(self.trace.from_time(start), self.round_trip)


class Pipe:
    """A link in use, first in first out, without loss and without bound: what is sent waits for what was sent before.

    Attributes:
        link: As given.
        free: Seconds at which the last byte sent so far will have left.
    """

    def __init__(self, link: Link) -> None:
        self.link, self.free = link, 0.0

    def send(self, t: float, nbytes: float) -> float:
        """When the last of so many bytes arrives, if they are handed over at time t; inf on a link that has died.

        Args:
            t: Seconds, never before the time of the call before.
            nbytes: Bytes >= 0.
        """
        start = max(t, self.free)
        if np.isfinite(start):
            start += self.link.trace.time_to_send(float(nbytes), start)
        self.free = start
        return start + self.link.delay
