"""The clock of all deadlines of a server, so that a test decides when one expires.

A deadline decides that somebody took too long. Pauses between steps of work (a tick, a retry) and measurements of a
link decide nothing; they use the time of the event loop. Seconds that never decrease.
"""

from __future__ import annotations

import asyncio
import heapq
import itertools
import threading
import time
from collections.abc import Awaitable, Callable
from contextlib import suppress
from typing import Protocol, TypeVar

__all__ = ["Clock", "ManualClock", "Timer"]

_T = TypeVar("_T")


class Timer(Protocol):
    """A call scheduled for later."""

    def cancel(self) -> None:
        """Cancel the call."""
        ...


class Clock:
    """The time of the machine."""

    def now(self) -> float:
        """Return seconds since some moment."""
        return time.monotonic()

    def call_later(self, seconds: float, call: Callable[[], object]) -> Timer:
        """Make a call in the running event loop once so many seconds have passed."""
        return asyncio.get_running_loop().call_later(seconds, call)

    async def within(self, seconds: float, work: Awaitable[_T]) -> _T:
        """Return the result of some work.

        Args:
            seconds: Most seconds that it may take.
            work: A coroutine or a future; cancelled when time is up.

        Raises:
            TimeoutError: If the work takes longer.
        """
        task = asyncio.ensure_future(work)
        late = asyncio.get_running_loop().create_future()
        timer = self.call_later(seconds, late.cancel)
        try:
            await asyncio.wait({task, late}, return_when=asyncio.FIRST_COMPLETED)
            if task.done():
                return task.result()
            raise TimeoutError
        finally:
            timer.cancel()
            late.cancel()
            if not task.done():
                task.cancel()
                with suppress(asyncio.CancelledError, Exception):
                    await task
            del task, late  # an error refers to this frame, and the task to its error


class ManualClock(Clock):
    """A clock that stands still until it is advanced, from any thread.

    Args:
        start: Initial time, seconds.

    Examples:
        >>> clock = ManualClock()
        >>> clock.advance(2.5)
        >>> clock.now()
        2.5
    """

    def __init__(self, start: float = 0.0) -> None:
        self._now = start
        self._lock = threading.Lock()
        self._numbers = itertools.count()
        self._due: list[tuple[float, int, _Call]] = []

    def now(self) -> float:
        """Return seconds since some moment."""
        return self._now

    @property
    def due(self) -> list[float]:
        """Seconds from now until each call that waits, shortest first; calls that were cancelled do not count."""
        with self._lock:
            return sorted(time - self._now for time, _, call in self._due if not call.is_cancelled)

    def call_later(self, seconds: float, call: Callable[[], object]) -> Timer:
        """Make a call in the running event loop once the clock has been advanced by so many seconds."""
        found = _Call(asyncio.get_running_loop(), call)
        with self._lock:
            heapq.heappush(self._due, (self._now + seconds, next(self._numbers), found))
        return found

    def advance(self, seconds: float) -> None:
        """Advance the time; pass due calls to their event loops, which run them soon after."""
        with self._lock:
            self._now += seconds
            due: list[_Call] = []
            while self._due and self._due[0][0] <= self._now:
                due.append(heapq.heappop(self._due)[2])
        for call in due:
            call.hand_over()


class _Call:
    """A call of `ManualClock` that waits for its time."""

    def __init__(self, loop: asyncio.AbstractEventLoop, call: Callable[[], object]) -> None:
        self._loop = loop
        self._call: Callable[[], object] | None = call

    @property
    def is_cancelled(self) -> bool:
        return self._call is None

    def cancel(self) -> None:
        self._call = None  # it may hold much alive until it is due

    def hand_over(self) -> None:
        with suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._run)

    def _run(self) -> None:
        if self._call is not None:
            self._call()
