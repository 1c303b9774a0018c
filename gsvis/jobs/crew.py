"""The scheduler of all work: calls of one function on the workers of a run, given out again when a worker is lost."""

from __future__ import annotations

from collections.abc import Callable, Generator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Future, wait
from typing import Any, Generic, TypeVar

from gsvis.errors import GsvisError
from gsvis.jobs.processes import Processes
from gsvis.jobs.workers import Workers

__all__ = ["Crew"]

Name = TypeVar("Name")
Result = TypeVar("Result")

_RESTARTS = 3  # losses of workers in a row without a finished job
_LOST = (BrokenExecutor, CancelledError)
_DASK_LOST = "KilledWorker"  # name of the error of a task whose workers died again and again


class Crew(Generic[Result]):
    """The workers of a run: this process, processes of this machine, or any executor.

    Use it in a `with` block, which ends the processes. They serve several runs.

    Args:
        workers: The workers.
        perform: The function that a worker calls.
        share: Returns its first arguments, the same for all jobs. It is called for each run, and again after a loss.
        ahead: Jobs that each process has at a time. An executor has two for each worker.
    """

    def __init__(
        self,
        workers: Workers,
        perform: Callable[..., Result],
        share: Callable[[], tuple[Any, ...]] = tuple,
        *,
        ahead: int = 1,
    ) -> None:
        self._perform = perform
        self._share = share
        self._executor = workers.executor
        self._processes = Processes(workers.count) if workers.executor is None and workers.count > 1 else None
        self._in_flight = 1
        if self._executor is not None:
            self._in_flight = 2 * workers.count
        elif self._processes is not None:
            self._in_flight = ahead * workers.count

    def __enter__(self) -> Crew[Result]:
        return self

    def __exit__(self, kind: type[BaseException] | None, *others: object) -> None:
        if self._processes is not None:
            self._processes.end(kill=kind is not None)

    def run(
        self, next_job: Callable[[], tuple[Name, Any] | None], put_back: Callable[[Name], None]
    ) -> Generator[tuple[Name, Future[Result]], None, None]:
        """Yield the name and the finished future of each job, in any order.

        Args:
            next_job: Returns the name and the last argument of the next job; None if no job can start now.
            put_back: Takes the name of a lost job, for `next_job` to return it again.

        Raises:
            GsvisError: If workers are lost more than three times in a row without a finished job.
        """
        waiting: dict[Future[Result], Name] = {}
        losses = 0
        try:
            while True:
                try:
                    shared = self._share()
                    while self._give_out(shared, waiting, next_job, put_back):
                        # Finished jobs before lost ones: the set has no order.
                        for future in sorted(wait(waiting, return_when=FIRST_COMPLETED).done, key=_is_lost):
                            if _is_lost(future):
                                future.result()  # raises
                            losses = 0
                            yield waiting.pop(future), future
                    return
                except _LOST as error:
                    losses += 1
                    if losses > _RESTARTS:
                        raise GsvisError(self._message()) from error
                    for future, name in waiting.items():
                        future.cancel()
                        put_back(name)
                    waiting.clear()
                    if self._processes is not None:
                        self._processes.end(kill=True)
                except Exception as error:
                    if type(error).__name__ == _DASK_LOST:
                        raise GsvisError(self._message()) from error
                    raise
        finally:
            for future in waiting:
                future.cancel()

    def _give_out(
        self,
        shared: tuple[Any, ...],
        waiting: dict[Future[Result], Name],
        next_job: Callable[[], tuple[Name, Any] | None],
        put_back: Callable[[Name], None],
    ) -> bool:
        """Submit jobs until enough are in flight; return whether any is."""
        while len(waiting) < self._in_flight and (found := next_job()) is not None:
            name, job = found
            try:
                waiting[self._submit(*shared, job)] = name
            except _LOST:
                put_back(name)
                raise
        return bool(waiting)

    def _submit(self, *given: Any) -> Future[Result]:
        """Return the future of a job; without an executor it runs at once."""
        executor = self._executor if self._processes is None else self._processes.executor()
        if executor is not None:
            return executor.submit(self._perform, *given)
        future: Future[Result] = Future()
        try:
            future.set_result(self._perform(*given))
        except Exception as error:
            future.set_exception(error)
        return future

    def _message(self) -> str:
        """Return the message for workers that were lost too often."""
        remedy = "use fewer --workers, another --max-memory or smaller tiles"
        if self._executor is not None:
            remedy = "are the scheduler and its workers alive, with enough memory?"
        return f"workers died again and again, probably out of memory; what is finished is kept: {remedy}"


def _is_lost(future: Future[Any]) -> bool:
    """Return whether the worker of a finished future was lost."""
    if future.cancelled():
        return True
    error = future.exception()
    return isinstance(error, _LOST) or type(error).__name__ == _DASK_LOST
