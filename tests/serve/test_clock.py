"""Deadlines expire when their clock says so, in its order, and not at all once they are cancelled."""

from __future__ import annotations

import asyncio
import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsvis.serve import Clock, ManualClock


@given(st.lists(st.integers(1, 9), max_size=8), st.lists(st.integers(0, 4), max_size=6))
def test_what_is_due_is_called_once_in_order_and_nothing_else(waits: list[int], steps: list[int]) -> None:
    async def called() -> list[int]:
        clock, calls = ManualClock(), []
        for k, wait in enumerate(waits):
            timer = clock.call_later(wait, lambda wait=wait: calls.append(wait))
            if k % 3 == 2:
                timer.cancel()
        for step in steps:
            clock.advance(step)
        await asyncio.sleep(0)
        return calls

    kept = [wait for k, wait in enumerate(waits) if k % 3 != 2]
    assert asyncio.run(called()) == sorted(wait for wait in kept if wait <= sum(steps))


def test_work_in_time_gives_its_result_and_late_work_is_cancelled() -> None:
    async def both() -> None:
        clock, begun, ended = ManualClock(), asyncio.Event(), []

        async def endless() -> None:
            begun.set()
            try:
                await asyncio.Event().wait()
            finally:
                ended.append(True)

        async def value() -> int:
            return 7

        assert await clock.within(1.0, value()) == 7
        late = asyncio.create_task(clock.within(1.0, endless()))
        await begun.wait()
        threading.Thread(target=clock.advance, args=(1.0,)).start()
        with pytest.raises(TimeoutError):
            await late
        assert ended == [True]

    asyncio.run(both())


def test_an_error_of_the_work_comes_through_and_so_does_cancellation() -> None:
    async def all_three() -> None:
        clock, begun = Clock(), asyncio.Event()

        async def broken() -> None:
            raise ZeroDivisionError

        async def endless() -> None:
            begun.set()
            await asyncio.Event().wait()

        with pytest.raises(ZeroDivisionError):
            await clock.within(3600.0, broken())
        waiting = asyncio.create_task(clock.within(3600.0, endless()))
        await begun.wait()
        waiting.cancel()
        with pytest.raises(asyncio.CancelledError):
            await waiting
        assert asyncio.all_tasks() == {asyncio.current_task()}

    asyncio.run(all_three())


def test_a_loop_that_has_ended_is_not_called() -> None:
    clock = ManualClock()

    async def leave() -> None:
        clock.call_later(1.0, lambda: pytest.fail("called"))

    asyncio.run(leave())
    clock.advance(2.0)


def test_calls_that_wait_are_listed() -> None:
    clock = ManualClock()

    async def three() -> None:
        clock.call_later(5.0, lambda: None)
        second = clock.call_later(2.0, lambda: None)
        clock.call_later(1.0, lambda: None)
        clock.advance(0.5)
        assert clock.due == [0.5, 1.5, 4.5]
        second.cancel()
        assert clock.due == [0.5, 4.5]
        clock.advance(0.5)
        assert clock.due == [4.0]

    asyncio.run(three())
