"""Run calls that may never return in separate threads, which do not delay the end of the program."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from threading import Thread
from typing import TypeVar

__all__ = ["call_apart"]

_Answer = TypeVar("_Answer")


def call_apart(call: Callable[[], _Answer], name: str) -> Future[_Answer]:
    """Return the future of a call that runs in a named daemon thread."""
    answer = Future[_Answer]()

    def run() -> None:
        """Run the call and set its result."""
        try:
            answer.set_result(call())
        except BaseException as error:
            answer.set_exception(error)

    Thread(target=run, name=name, daemon=True).start()
    return answer
