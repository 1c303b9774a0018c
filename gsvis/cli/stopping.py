"""Delay Ctrl-C to the end of a step, when unfinished work is consistent, and say what is kept of it."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

from gsvis.errors import OutputError

__all__ = ["RESUME", "between_steps", "resumable"]

RESUME = "run the same command to resume"
"""What to do after an interruption."""


@contextmanager
def resumable(kept: str, then: str = RESUME, *, has: Callable[[], bool] = lambda: True) -> Iterator[None]:
    """Say what is kept if the block is interrupted or cannot write.

    Args:
        kept: What is kept, and where.
        then: What to do after an interruption.
        has: Returns whether anything is kept by then.
    """
    try:
        yield
    except KeyboardInterrupt:
        if not has():
            raise
        raise KeyboardInterrupt(f"{kept}; {then}") from None
    except OutputError as error:
        if not has():
            raise
        raise error.keeping(kept) from error


@contextmanager
def between_steps() -> Iterator[Callable[[], None]]:
    """Delay Ctrl-C and SIGTERM to the end of a step; a second signal stops at once.

    Yields:
        A function to call between two steps. It raises KeyboardInterrupt if a signal has arrived.
    """
    asked = False

    def ask(number: int, frame: FrameType | None) -> None:
        nonlocal asked
        if asked:
            raise KeyboardInterrupt
        asked = True

    def stop_if_asked() -> None:
        if asked:
            raise KeyboardInterrupt

    before: dict[signal.Signals, Any] = {}
    try:
        for number in (signal.SIGINT, signal.SIGTERM):
            before[number] = signal.signal(number, ask)
    except ValueError:  # not in the main thread: leave signals alone
        pass
    try:
        yield stop_if_asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
