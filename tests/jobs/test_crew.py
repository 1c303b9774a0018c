"""A crew gives every job a result, whenever its workers are lost."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future
from typing import Any

import pytest

from gsvis.errors import GsvisError
from gsvis.jobs.crew import Crew
from gsvis.jobs.workers import Workers


class KilledWorker(Exception):  # noqa: N818
    """The error of a task that Dask gives up, by its name."""


class Losing(Executor):
    """Loses every third job, in one way."""

    def __init__(self, way: str) -> None:
        self.way = way
        self.count = 0

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        self.count += 1
        future: Future[Any] = Future()
        lost = self.count % 3 == 0
        if lost and self.way == "submit":
            raise BrokenExecutor
        if lost and self.way == "cancel":
            future.cancel()
            future.set_running_or_notify_cancel()
        elif lost:
            future.set_exception(
                {"broken": BrokenExecutor(), "given up": KilledWorker()}.get(self.way, CancelledError())
            )
        else:
            future.set_result(fn(*args, **kwargs))
        return future


def run(crew: Crew[int], count: int) -> Iterator[tuple[int, int]]:
    left = deque(range(count))
    for name, future in crew.run(lambda: (left[0], left.popleft()) if left else None, left.appendleft):
        yield name, future.result()


@pytest.mark.parametrize("way", ["submit", "cancel", "cancelled", "broken"])
def test_lost_jobs_are_done_again_with_what_is_shared_anew(way: str) -> None:
    shared: list[int] = []

    def share() -> tuple[int]:
        shared.append(10)
        return (10,)

    crew = Crew(Workers(1, executor=Losing(way)), lambda a, b: a * b, share)
    assert sorted(run(crew, 7)) == [(k, 10 * k) for k in range(7)]
    assert len(shared) > 1


def test_a_task_that_dask_gives_up_is_not_given_out_again() -> None:
    crew = Crew(Workers(1, executor=Losing("given up")), abs)
    with pytest.raises(GsvisError, match=r"again and again.*are the scheduler and its workers alive"):
        list(run(crew, 7))


def test_an_error_of_a_job_ends_no_other() -> None:
    names = []
    left = deque([1, 0, 2])
    for name, future in Crew(Workers(), lambda k: 1 // k).run(
        lambda: (left[0], left.popleft()) if left else None, left.appendleft
    ):
        names.append((name, type(future.exception())))
    assert names == [(1, type(None)), (0, ZeroDivisionError), (2, type(None))]
