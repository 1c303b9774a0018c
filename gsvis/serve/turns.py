"""Turns of the clients of one thread: between two of them the event loop looks at all sockets.

Without turns, a loop with fifty busy clients plans for all of them before it reads an acknowledgement. The sessions
would then measure the server instead of their links.
"""

from __future__ import annotations

import asyncio
from collections import deque

__all__ = ["Turns"]


class Turns:
    """Let one task after the other do work that blocks the event loop, in the order in which they ask.

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
        self._waiting: deque[asyncio.Future[None]] = deque()
        self._taken = False

    async def take(self) -> None:
        """Wait for a turn, which lasts until the task waits for something else."""
        loop = asyncio.get_running_loop()
        if self._taken:
            mine = loop.create_future()
            self._waiting.append(mine)
            try:
                await mine
            except asyncio.CancelledError:
                if mine.done() and not mine.cancelled():
                    self._give_on()
                raise
        self._taken = True
        loop.call_soon(self._give_on)  # after the loop has looked at the sockets

    def _give_on(self) -> None:
        while self._waiting:
            waiting = self._waiting.popleft()
            if not waiting.done():
                waiting.set_result(None)
                return
        self._taken = False
