"""What a client has said and nobody has used yet: poses and acknowledgements, with limits on their number and rate.

A client cannot make the mailbox grow: it holds at most 256 messages, and a client that sends more is disconnected.
Seconds; the server's clock for rates, and the clock that measures links for arrivals.
"""

from __future__ import annotations

import asyncio

from gsvis.errors import ProtocolError
from gsvis.serve.limits import Limits, RateBucket
from gsvis.stream import Ack, PoseAt
from gsvis.stream.wire import FAULTS

__all__ = ["Mailbox", "PoseClock"]

_MOST_WAITING = 256  # most poses and acknowledgements that wait


class PoseClock:
    """Convert times of a client's clock to the server's clock, with the smallest recent delay.

    After a stall many poses arrive at once. The predictor needs the times at which they were taken.
    """

    _CREEP = 1e-3  # seconds per second by which the delay grows: clocks differ in speed

    def __init__(self) -> None:
        self._offset: float | None = None
        self._ms = 0
        self._turns = 0
        self._arrived = 0.0

    def at(self, arrived: float, time_ms: int) -> float:
        """Return the server's seconds at which a pose was taken, never later than its arrival.

        Args:
            arrived: Arrival of the pose, seconds of the server.
            time_ms: Milliseconds of the client; they start again after 2^32.
        """
        if self._offset is not None and self._ms - time_ms > 1 << 31:
            self._turns += 1
        seconds = (time_ms + (self._turns << 32)) / 1e3
        offset = arrived - seconds
        if self._offset is not None:
            offset = min(offset, self._offset + self._CREEP * (arrived - self._arrived))
        self._offset = offset
        self._ms = time_ms
        self._arrived = arrived
        return seconds + offset


class Mailbox:
    """The messages of one client that wait to be used.

    One task puts messages in, another takes them out. The other task may sleep until the bell rings.

    Args:
        limits: Bounds; those of message rates count here.

    Attributes:
        clock: Converts the times of the client's poses.
    """

    def __init__(self, limits: Limits) -> None:
        self._messages = RateBucket(limits.messages_per_s, limits.messages_per_s * limits.burst_s)
        self._poses = RateBucket(limits.poses_per_s, limits.poses_per_s)
        self.clock = PoseClock()
        self._waiting: list[tuple[float, PoseAt | Ack]] = []
        self._bell: asyncio.Future[None] | None = None

    def __len__(self) -> int:
        return len(self._waiting)

    def admit(self, now: float) -> None:
        """Count a message of any kind.

        Args:
            now: Seconds of the server's clock.

        Raises:
            ProtocolError: If the client sends messages too fast.
        """
        if not self._messages.take(now):
            raise ProtocolError("messages: expected fewer, got a flood", FAULTS["flood"])

    def put(self, message: PoseAt | Ack, now: float, arrived: float) -> bool:
        """Add a message; return False for a pose that is ignored because there are too many.

        Args:
            message: The message.
            now: Seconds of the server's clock.
            arrived: Arrival of the message, seconds of the clock that measures links.

        Raises:
            ProtocolError: If too many acknowledgements wait.
        """
        if isinstance(message, PoseAt) and not self._poses.take(now):
            return False
        if len(self._waiting) >= _MOST_WAITING:  # the other task waits for room in the socket buffer
            self._waiting = [entry for entry in self._waiting if isinstance(entry[1], Ack)]
            if len(self._waiting) >= _MOST_WAITING:
                raise ProtocolError("ACK: expected one a message, got more", FAULTS["flood"])
        self._waiting.append((arrived, message))
        return True

    def take(self) -> list[tuple[float, PoseAt | Ack]]:
        """Take all messages out: their arrivals, and they themselves, in their order."""
        found = self._waiting
        self._waiting = []
        return found

    def ring(self) -> None:
        """Wake the task that waits for the bell."""
        if self._bell is not None and not self._bell.done():
            self._bell.set_result(None)

    async def wait(self, seconds: float) -> None:
        """Wait until the bell rings, at most some seconds of the event loop."""
        loop = asyncio.get_running_loop()
        self._bell = loop.create_future()
        timer = loop.call_later(seconds, self.ring)
        try:
            await self._bell
        finally:
            timer.cancel()
            self._bell = None
