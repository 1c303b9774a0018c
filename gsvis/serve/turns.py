"""Turns of the clients of one thread: to plan for them, to make what they wait for, and to read what they sent.

Between two turns the event loop looks at all sockets.

Without turns, a loop with fifty busy clients plans for all of them before it reads an acknowledgement. The sessions
would then measure the server instead of their links.
"""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

__all__ = ["Preparations", "Readings", "Turns"]

_IN_A_ROW = 3  # turns of newcomers while others wait
_SHARE_S = 0.0005  # seconds for which one client is read before another
_TURN_S = 0.001  # seconds for which clients are read before the loop looks at all sockets


class _Queue:
    """Tasks that wait for one place: newcomers first, both kinds in the order of asking.

    A newcomer sees nothing yet, and needs little; what others get is larger. Others have every fourth turn at least.
    """

    def __init__(self) -> None:
        self._newcomers = deque[asyncio.Future[None]]()
        self._others = deque[asyncio.Future[None]]()
        self._taken = False
        self._row = 0

    async def enter(self, *, is_new: bool) -> None:
        """Wait for the place, and take it."""
        if self._taken:
            mine = asyncio.get_running_loop().create_future()
            (self._newcomers if is_new else self._others).append(mine)
            try:
                await mine
            except asyncio.CancelledError:
                if mine.done() and not mine.cancelled():
                    self.leave()
                raise
        self._taken = True

    def leave(self) -> None:
        """Give the place to the next."""
        for waiting in (self._newcomers, self._others):  # those that were cancelled
            while waiting and waiting[0].done():
                waiting.popleft()
        if self._newcomers and (not self._others or self._row < _IN_A_ROW):
            self._row = self._row + 1 if self._others else 0
            self._newcomers.popleft().set_result(None)
        elif self._others:
            self._row = 0
            self._others.popleft().set_result(None)
        else:
            self._taken = False


class Turns:
    """Let one task after the other do work that blocks the event loop, newcomers before others.

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

    def __init__(self) -> None:
        self._queue = _Queue()

    async def take(self, *, is_new: bool = False) -> None:
        """Wait for a turn, which lasts until the task waits for something else.

        Args:
            is_new: Whether the work is for a client that has no picture yet.
        """
        await self._queue.enter(is_new=is_new)
        asyncio.get_running_loop().call_soon(self._queue.leave)  # after the loop has looked at the sockets


class Preparations:
    """Make what clients wait for, such as a cell that nobody has been in: in a thread, one after the other.

    The event loop goes on meanwhile. It reads acknowledgements when they arrive, so that sessions measure their links,
    and plans for those whose cells are there. Kernels release Python's lock, so another core does most of the work.
    With two at once on one core most newcomers would wait as long as the last.
    """

    def __init__(self) -> None:
        self._queue = _Queue()
        self._thread = ThreadPoolExecutor(1, "gsvis-prepare")

    async def make(self, work: Callable[[], object], *, is_new: bool = False) -> None:
        """Call a function in a thread when it is its turn, and wait for it; raises what it raises.

        Args:
            work: The function.
            is_new: Whether the work is for a client that has no picture yet.
        """
        await self._queue.enter(is_new=is_new)
        try:
            await asyncio.get_running_loop().run_in_executor(self._thread, work)
        finally:
            self._queue.leave()


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
        self._measure = measure
        self._call = call
        self._waiting: deque[Callable[[], bool]] = deque()

    def add(self, read: Callable[[], bool]) -> None:
        """Call a function from the next turn of the loop on; it reads a slice and returns whether there is more."""
        self._waiting.append(read)
        if len(self._waiting) == 1:
            self._call_later()

    def _run(self) -> None:
        """Read for the time of a turn."""
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
        """Run again in a later turn of the loop."""
        (self._call or asyncio.get_running_loop().call_soon)(self._run)

    def _read_for_a_while(self) -> None:
        """Read the first, and put it behind the others if it has more."""
        end = self._measure() + _SHARE_S
        has_more = False
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
