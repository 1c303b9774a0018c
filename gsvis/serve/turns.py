"""Turns of the clients of one thread, to plan for them and to read what they sent.

Between two turns the event loop looks at all sockets.

Without turns, a loop with fifty busy clients plans for all of them before it reads an acknowledgement. The sessions
would then measure the server instead of their links.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections import deque
from collections.abc import Callable

__all__ = ["Readings", "Turns"]

_SHARE_S = 0.0005  # seconds for which one client is read before another
_TURN_S = 0.001  # seconds for which clients are read before the loop looks at all sockets


class Turns:
    """Let one task after the other do work that blocks the event loop, in the order in which they ask.

    Long work comes after short work: twenty newcomers whose cells have to be made would else wait for all twenty cells
    before one of them gets its second message. Where both wait, each has half of the time.

    Args:
        measure: Function that returns seconds, never decreasing.

    Examples:
        >>> async def work(turns: Turns, number: int, done: list[int]) -> None:
        ...     await turns.take()
        ...     done.append(number)
        >>> async def main() -> list[int]:
        ...     turns, done = Turns(), []
        ...     await asyncio.gather(*(work(turns, number, done) for number in range(4)))
        ...     return done
        >>> asyncio.run(main())
        [0, 1, 2, 3]
    """

    def __init__(self, measure: Callable[[], float] = time.perf_counter) -> None:
        self._measure = measure
        self._short, self._long = deque[asyncio.Future[None]](), deque[asyncio.Future[None]]()
        self._taken = False
        self._began: float | None = None  # the turn of long work that runs
        self._due = -math.inf  # when long work is before short work again

    async def take(self, *, is_long: bool = False) -> None:
        """Wait for a turn, which lasts until the task waits for something else.

        Args:
            is_long: Whether the work may take ten times as long as that of others.
        """
        loop = asyncio.get_running_loop()
        if self._taken:
            mine = loop.create_future()
            (self._long if is_long else self._short).append(mine)
            try:
                await mine
            except asyncio.CancelledError:
                if mine.done() and not mine.cancelled():
                    self._give_on()
                raise
        self._taken = True
        self._began = self._measure() if is_long else None
        loop.call_soon(self._give_on)  # after the loop has looked at the sockets

    def _give_on(self) -> None:
        if self._began is not None:
            now = self._measure()
            self._due, self._began = now + (now - self._began), None
        for waiting in (self._short, self._long):  # those that were cancelled
            while waiting and waiting[0].done():
                waiting.popleft()
        if self._long and (not self._short or self._measure() >= self._due):
            self._long.popleft().set_result(None)
        elif self._short:
            self._short.popleft().set_result(None)
        else:
            self._taken = False


class Readings:
    """Read what clients have sent in bursts: in turn, each for a short time, a little in each turn of the event loop.

    Time is shared and not bytes, because a byte of small frames costs a hundred times a byte of a large one.

    Args:
        measure: Function that returns seconds, never decreasing.
        call: Makes a call when the event loop has time for bursts; None means in each turn.
    """

    def __init__(
        self,
        measure: Callable[[], float] = time.perf_counter,
        call: Callable[[Callable[[], object]], object] | None = None,
    ) -> None:
        self._measure, self._call = measure, call
        self._waiting: deque[Callable[[], bool]] = deque()

    def add(self, read: Callable[[], bool]) -> None:
        """Call a function from the next turn of the loop on; it reads a slice and returns whether there is more."""
        self._waiting.append(read)
        if len(self._waiting) == 1:
            self._call_later()

    def _run(self) -> None:
        end = self._measure() + _TURN_S
        try:
            while self._waiting:
                self._read_for_a_while()
                if self._measure() >= end:
                    break
        finally:  # whatever one of them raises, the others go on
            if self._waiting:
                self._call_later()

    def _call_later(self) -> None:
        (self._call or asyncio.get_running_loop().call_soon)(self._run)

    def _read_for_a_while(self) -> None:
        """Read the first, and put it behind the others if it has more."""
        end, has_more = self._measure() + _SHARE_S, False
        try:
            while has_more := self._waiting[0]():
                if self._measure() >= end:
                    break
        except BaseException:
            has_more = False
            raise
        finally:
            read = self._waiting.popleft()
            if has_more:
                self._waiting.append(read)
