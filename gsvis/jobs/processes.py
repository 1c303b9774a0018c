"""Processes of this machine that run tasks, each with one thread; they end with the process that started them."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from multiprocessing import get_context, parent_process
from typing import Any

from numba import get_num_threads, set_num_threads

from gsvis.files.cache import Cache

__all__ = ["Processes", "limit_threads", "one_at_a_time", "ready", "use_threads"]

one_at_a_time = threading.RLock()
"""Held while a task runs, also by a task inside of another one: kernels must not run from two threads under numba's
default threading layer."""

ready: Cache[Any] = Cache(max_items=1)
"""What tasks of this process have prepared and the next ones use again, such as the last scene, by its key."""

_threads: list[int] = []  # at most one entry: threads that kernels of this process may use


def use_threads(count: int | None) -> None:
    """Set how many threads the kernels of this process may use for tasks; None for all."""
    _threads[:] = [] if count is None else [count]


def limit_threads() -> None:
    """Apply the limit of `use_threads` to the kernels that run next in this thread."""
    if _threads:
        set_num_threads(min(_threads[0], get_num_threads()))


class Processes:
    """Up to `count` processes with one thread each, for several runs; each starts with the first task that needs it.

    Used in a `with` block: an exception in it kills the processes at once.
    """

    def __init__(self, count: int) -> None:
        self.count = count
        self._pool: _Pool | None = None

    def __enter__(self) -> Processes:
        return self

    def __exit__(self, kind: type[BaseException] | None, *others: object) -> None:
        self.end(kill=kind is not None)

    def executor(self) -> Executor:
        """Return the pool; a new one, if there is none."""
        if self._pool is None:
            # Spawned, not forked: a forked process would inherit numba's threads in an unusable state.
            self._pool = _Pool(self.count, mp_context=get_context("spawn"), initializer=_begin)
        return self._pool

    def end(self, *, kill: bool) -> None:
        """End the processes; `kill` does not wait for their tasks."""
        pool = self._pool
        self._pool = None
        if pool is None:
            return
        if kill:
            for process in list((pool._processes or {}).values()):
                process.kill()
        pool.shutdown(wait=True, cancel_futures=True)


class _Pool(ProcessPoolExecutor):
    """A pool whose processes ignore Ctrl-C from their start, because they inherit a signal mask."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Submit a call while Ctrl-C is blocked, so that new processes ignore it."""
        if not hasattr(signal, "pthread_sigmask"):
            return super().submit(fn, *args, **kwargs)
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            return super().submit(fn, *args, **kwargs)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _begin() -> None:
    """Initialize a worker process: use one thread, and exit when the parent exits."""

    def watch() -> None:
        """Exit when the parent process exits."""
        parent = parent_process()
        assert parent is not None
        parent.join()  # waits on a pipe that only the parent holds; no polling
        os._exit(1)

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    use_threads(1)
    threading.Thread(target=watch, daemon=True).start()
