"""Call a function for many items in a few threads, and yield the results in the order of the items."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

from numba import get_num_threads

from gsvis._kernels.threads import one_thread

__all__ = ["in_order"]

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


def in_order(
    function: Callable[[_Item], _Result], items: Iterable[_Item], threads: int | None = None
) -> Iterator[_Result]:
    """Yield function(item) for each item, in order. Items are taken in the caller's thread, a few ahead.

    Kernels that a function calls have one thread each. So this pays where a function spends its time in kernels or
    compression, which hold no lock of Python.

    Args:
        function: Called in other threads, for several items at the same time.
        items: Anything; at most one item more than there are threads waits.
        threads: How many items are worked on at the same time; 1 where the caller works meanwhile. None means as many
            as kernels have threads.
    """
    threads = threads or get_num_threads()

    def alone(item: _Item) -> _Result:
        """Return the result of an item."""
        with one_thread():
            return function(item)

    waiting: deque[Future[_Result]] = deque()
    with ThreadPoolExecutor(threads, thread_name_prefix="gsvis-order") as pool:
        for item in items:
            waiting.append(pool.submit(alone, item))
            if len(waiting) > threads:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
