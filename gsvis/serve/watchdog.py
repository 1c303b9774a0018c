"""The deadlines of a client that streams: it must say something, and acknowledge what it gets."""

from __future__ import annotations

from collections.abc import Callable

from gsvis.errors import ProtocolError
from gsvis.serve.clock import Clock, Timer
from gsvis.serve.limits import Limits
from gsvis.stream.wire import FAULTS

__all__ = ["Watchdog"]

_SLACK = 1e-6  # seconds of rounding error


class Watchdog:
    """Notice that a client is silent, or does not read what it is sent.

    Args:
        limits: Bounds; `idle_s` and `stall_s` count here.
        clock: Clock of the deadlines.
        wake: Called when it is time to `check` again.
    """

    def __init__(self, limits: Limits, clock: Clock, wake: Callable[[], object]) -> None:
        self._limits = limits
        self._clock = clock
        self._wake = wake
        self._heard = clock.now()
        self._moved = self._heard
        self._alarm: Timer | None = None

    @property
    def silent_s(self) -> float:
        """Seconds since the last message of the client."""
        return self._clock.now() - self._heard

    def hear(self) -> float:
        """Note a message of the client; return the time, seconds of the clock."""
        self._heard = self._clock.now()
        return self._heard

    def progress(self) -> None:
        """Note that the client has acknowledged something new."""
        self._moved = self._clock.now()

    def check(self, outstanding: int) -> None:
        """Raise if a deadline has passed; otherwise call `wake` at the next one.

        Args:
            outstanding: Bytes that the client has not acknowledged.

        Raises:
            ProtocolError: If the client was silent for `idle_s`, or acknowledged nothing for `stall_s`.
        """
        limits = self._limits
        now = self._clock.now()
        if now - self._heard >= limits.idle_s - _SLACK:
            raise ProtocolError(f"no message within {limits.idle_s:g} s; closing", FAULTS["late"])
        if outstanding == 0:
            self._moved = now
        if now - self._moved >= limits.stall_s - _SLACK:
            raise ProtocolError(f"no ACK within {limits.stall_s:g} s; closing", FAULTS["late"])
        if self._alarm is None:
            due = min(self._heard + limits.idle_s, self._moved + limits.stall_s)
            self._alarm = self._clock.call_later(due - now, self._ring)

    def stop(self) -> None:
        """Call `wake` no more."""
        if self._alarm is not None:
            self._alarm.cancel()
            self._alarm = None

    def _ring(self) -> None:
        self._alarm = None
        self._wake()
