"""Run a compiled kernel on several of Python's threads, each with a part of the work.

With `parallel=True`, numba would type and optimize the body of a loop three times, and compilation would take two to
four times as long. Here the kernel is a plain one that releases the GIL (`nogil=True`, with `error_model="numpy"` as in
numba's own threads). A call costs a few tens of microseconds more. Kernels whose calls take a millisecond or less use
numba's threads instead, through `share`.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import update_wrapper
from typing import Any

import numpy as np
from numba import get_num_threads, set_num_threads

__all__ = ["in_parts", "in_threads", "on_numba_threads", "one_thread"]

_pools: dict[int, ThreadPoolExecutor] = {}


def in_parts(count: Callable[..., int]) -> Callable[[Any], Callable[..., None]]:
    """Decorate kernel(first, last, *arguments) to be called as kernel(*arguments): each thread gets a range of rows.

    Args:
        count: Returns the number of rows, from the arguments.
    """

    def wrap(kernel: Any) -> Callable[..., None]:
        """Return the decorated kernel."""

        def run(*arguments: Any) -> None:
            """Call the kernel."""
            rows = count(*arguments)
            threads = max(min(get_num_threads(), rows), 1)
            ends = [rows * k // threads for k in range(threads + 1)]
            _run_all(kernel, [(ends[k], ends[k + 1], *arguments) for k in range(threads)])

        return _named_as(kernel, run)

    return wrap


def in_threads(units: Callable[..., int]) -> Callable[[Any], Callable[..., None]]:
    """Decorate kernel(taken, *arguments) to be called as kernel(*arguments): threads take units until none is left.

    `taken` (1,) int64 is the counter for `take_next`, 0 at the start.

    Args:
        units: Returns the number of units, from the arguments; at most that many threads are used.
    """

    def wrap(kernel: Any) -> Callable[..., None]:
        """Return the decorated kernel."""

        def run(*arguments: Any) -> None:
            """Call the kernel."""
            threads = max(min(get_num_threads(), units(*arguments)), 1)
            _run_all(kernel, [(np.zeros(1, np.int64), *arguments)] * threads)

        return _named_as(kernel, run)

    return wrap


def on_numba_threads(kernel: Any) -> Callable[..., None]:
    """Decorate a kernel that calls `share`: numba's threads are started before its code is loaded."""

    def run(*arguments: Any) -> None:
        """Call the kernel."""
        get_num_threads()  # starts them, at the first call
        kernel(*arguments)

    return _named_as(kernel, run)


@contextmanager
def one_thread() -> Iterator[None]:
    """Run kernels in one thread in this context: small ones are faster, and processor time equals elapsed time."""
    before = get_num_threads()
    set_num_threads(1)
    try:
        yield
    finally:
        set_num_threads(before)


def _named_as(kernel: Any, run: Callable[..., None]) -> Callable[..., None]:
    """Return `run` with the name and docstring of a kernel, and the kernel as its attribute `kernel`."""
    update_wrapper(run, getattr(kernel, "py_func", kernel))
    run.kernel = kernel  # type: ignore[attr-defined]
    return run


def _run_all(kernel: Callable[..., object], calls: list[tuple[Any, ...]]) -> None:
    """Make all calls, the first in this thread; wait for all, then raise the error of one, if any."""
    others = [_pool().submit(kernel, *call) for call in calls[1:]]
    try:
        kernel(*calls[0])
    finally:
        for other in others:
            other.result()


def _pool() -> ThreadPoolExecutor:
    """Return the thread pool of this process; a fork does not inherit the threads of its parent."""
    if os.getpid() not in _pools:
        _pools.clear()
        _pools[os.getpid()] = ThreadPoolExecutor(os.cpu_count(), thread_name_prefix="gsvis-kernel")
    return _pools[os.getpid()]
