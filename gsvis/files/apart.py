"""Calls that may never return: in threads of their own, for which the end of the program does not wait."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from threading import Thread
from typing import TypeVar

__all__ = ["call_apart"]

_Answer = TypeVar("_Answer")


def call_apart(call: Callable[[], _Answer], name: str) -> Future[_Answer]:
    """Return the answer to come of a call that runs in a daemon thread of a name."""
    answer = Future[_Answer]()

    def run() -> None:
        try:
            answer.set_result(call())
        except BaseException as error:
            answer.set_exception(error)

    Thread(target=run, name=name, daemon=True).start()
    return answer
