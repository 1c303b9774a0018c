"""Viewers first: which sockets the event loop looks at in a turn.

Sockets of viewers are looked at in every turn. All others (handshakes, requests, refusals, closing connections), new
connections and bursts of frames get slots: a few sockets at a time, when viewers want nothing, and otherwise so often
that they have a share of the processor. So whatever others send at once, a batch for a viewer waits for one slot.
"""

from __future__ import annotations

import asyncio
import selectors
import time
from collections import deque
from collections.abc import Callable, Coroutine, Sequence
from typing import Any

__all__ = ["Precedence", "ViewersFirst", "run"]

_EVENTS = 4  # most sockets of a slot, and most calls; a TLS handshake takes half a millisecond
_SHARE = 0.25  # of the processor for slots while viewers want it

_Event = tuple[selectors.SelectorKey, int]


class Precedence:
    """Decide which ready sockets a turn of the event loop handles.

    Args:
        measure: Function that returns seconds of processor time, never decreasing.
    """

    def __init__(self, measure: Callable[[], float] = time.thread_time) -> None:
        self._measure = measure
        self._behind: dict[int, object] = {}
        self._owed: dict[int, None] = {}  # ready and not handled, longest first
        self._calls: deque[Callable[[], object]] = deque()
        self._began: float | None = None
        self._due = 0.0

    @property
    def has_calls(self) -> bool:
        """Whether calls wait for a slot."""
        return bool(self._calls)

    def put(self, fd: int, owner: object, *, is_first: bool) -> None:
        """Look at a socket in every turn, or in slots."""
        if is_first:
            self.forget(fd, owner)
        else:
            self._behind[fd] = owner

    def forget(self, fd: int, owner: object) -> None:
        """Forget a socket, unless its number belongs to another owner by now."""
        if self._behind.get(fd) is owner:
            del self._behind[fd]

    def call(self, call: Callable[[], object]) -> None:
        """Make a call in the running event loop in the next slot."""
        loop = asyncio.get_running_loop()
        self._calls.append(lambda: loop.call_soon(call))

    def end_turn(self) -> None:
        """Note that the loop has handled what `choose` returned."""
        if self._began is not None:
            now = self._measure()
            self._due = now + (now - self._began) * (1.0 / _SHARE - 1.0)
            self._began = None

    def choose(self, ready: Sequence[_Event], *, is_busy: bool) -> list[_Event]:
        """Return the events to handle in this turn.

        Args:
            ready: Events of all sockets.
            is_busy: Whether the loop has other work in this turn.
        """
        if not self._calls and not any(event[0].fd in self._behind for event in ready):  # as in most turns
            self._owed.clear()
            return list(ready)
        behind = {event[0].fd: event for event in ready if event[0].fd in self._behind}
        chosen = [event for event in ready if event[0].fd not in behind]
        self._owed = dict.fromkeys([*(fd for fd in self._owed if fd in behind), *behind])
        if not (behind or self._calls):
            return chosen
        if (is_busy or chosen) and self._measure() < self._due:
            return chosen
        self._began = self._measure()
        for fd in list(self._owed)[:_EVENTS]:
            del self._owed[fd]
            chosen.append(behind[fd])
        for _ in range(min(_EVENTS, len(self._calls))):
            self._calls.popleft()()
        return chosen


class ViewersFirst(selectors.DefaultSelector):
    """A selector for an event loop that keeps a precedence.

    Args:
        precedence: Decides.
    """

    def __init__(self, precedence: Precedence) -> None:
        super().__init__()
        self._precedence = precedence

    def select(self, timeout: float | None = None) -> list[_Event]:
        """Return the events to handle; see `selectors.BaseSelector.select`."""
        self._precedence.end_turn()
        ready = super().select(0.0 if self._precedence.has_calls else timeout)
        return self._precedence.choose(ready, is_busy=timeout is not None and timeout <= 0.0)


def run(main: Coroutine[Any, Any, None], precedence: Precedence) -> None:
    """Run a coroutine in an event loop that keeps a precedence, as `asyncio.run` does."""
    loop = asyncio.SelectorEventLoop(ViewersFirst(precedence))
    try:
        loop.run_until_complete(main)
    finally:
        try:
            left = asyncio.all_tasks(loop)
            for task in left:
                task.cancel()
            if left:
                loop.run_until_complete(asyncio.gather(*left, return_exceptions=True))
            loop.run_until_complete(loop.shutdown_asyncgens())
            loop.run_until_complete(loop.shutdown_default_executor())
        finally:
            loop.close()
