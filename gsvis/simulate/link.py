"""Model a link between a server and one client: bytes travel in sequence at a given rate, with a delay.

Seconds and bytes. The uplink carries poses and acknowledgements, which are small: it has a delay and no rate.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsvis.abr.traces import BandwidthTrace

__all__ = ["Link", "Pipe"]


@dataclass(frozen=True)
class Link:
    """A link between server and client.

    Attributes:
        trace: Rate from the server to the client.
        round_trip: Seconds that a byte takes there and back on an idle link, half of them each way.
    """

    trace: BandwidthTrace
    round_trip: float = 0.04

    def __post_init__(self) -> None:
        if not (np.isfinite(self.round_trip) and self.round_trip >= 0):
            raise ValueError(f"round_trip: expected finite seconds >= 0, got {self.round_trip!r}")

    @property
    def delay(self) -> float:
        """Delay each way, seconds."""
        return 0.5 * self.round_trip

    def from_time(self, start: float) -> Link:
        """Return the same link with a later start."""
        return Link(self.trace.from_time(start), self.round_trip)


class Pipe:
    """A link in use: first in, first out, without loss and without limit; new bytes wait for earlier ones.

    Attributes:
        link: The link.
        free: Seconds at which the last byte so far will have left.
    """

    def __init__(self, link: Link) -> None:
        self.link = link
        self.free = 0.0

    def send(self, t: float, nbytes: float) -> float:
        """Return the time at which the last of some bytes arrives, if sent at time t; inf on a dead link.

        Args:
            t: Seconds, not before the time of the previous call.
            nbytes: Number of bytes, >= 0.
        """
        start = max(t, self.free)
        if np.isfinite(start):
            start += self.link.trace.time_to_send(float(nbytes), start)
        self.free = start
        return start + self.link.delay
