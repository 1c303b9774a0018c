"""Turns: one task between two looks at the sockets, in the order of asking, whoever leaves."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path

from gsvis.errors import FormatError
from gsvis.serve.turns import Preparations, Readings, Turns


def test_the_loop_runs_between_two_turns() -> None:
    async def main() -> list[str]:
        turns, seen, loop = Turns(), list[str](), asyncio.get_running_loop()

        async def work(name: str) -> None:
            await turns.take()
            seen.append(name)
            loop.call_soon(seen.append, "-")

        await asyncio.gather(*(work(name) for name in "abc"))
        await asyncio.sleep(0)
        return seen

    assert asyncio.run(main()) == ["a", "-", "b", "-", "c", "-"]


def test_nobody_waits_for_a_task_that_was_cancelled() -> None:
    """Whether it was waiting, or had just been given its turn."""

    async def main(spins: int) -> list[int]:
        turns, done = Turns(), list[int]()

        async def work(number: int) -> None:
            await turns.take()
            done.append(number)

        tasks = [asyncio.create_task(work(number)) for number in range(4)]
        for _ in range(spins):
            await asyncio.sleep(0)
        tasks[1].cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        await work(4)
        return done

    for spins in range(6):
        done = asyncio.run(main(spins))
        assert done in ([0, 2, 3, 4], [0, 1, 2, 3, 4])
    assert asyncio.run(main(2)) == [0, 2, 3, 4]


def test_who_asks_alone_need_not_wait() -> None:
    async def main() -> bool:
        turns = Turns()
        await asyncio.wait_for(turns.take(), 5.0)
        await asyncio.sleep(0)
        taking = turns.take()
        try:
            taking.send(None)
        except StopIteration:
            return True
        return False

    assert asyncio.run(main())


def test_newcomers_come_first_and_others_have_every_fourth_turn() -> None:
    async def main() -> str:
        turns, done = Turns(), list[str]()

        async def work(name: str, times: int, *, is_new: bool) -> None:
            for _ in range(times):
                await turns.take(is_new=is_new)
                done.append(name)

        await asyncio.gather(*(work("o", 3, is_new=False) for _ in range(2)), work("N", 7, is_new=True))
        return "".join(done)

    assert asyncio.run(main()) == "oNNNoNNNoNooo"  # the first asked before anybody else


def test_what_clients_wait_for_is_made_in_turn_while_the_loop_goes_on() -> None:
    async def main() -> tuple[list[str], int]:
        preparations, made, looks = Preparations(), list[str](), 0
        begun, end = threading.Event(), threading.Event()

        def hold() -> None:
            begun.set()
            assert end.wait(60.0)
            made.append("held")

        tasks = [asyncio.create_task(preparations.make(hold))]
        while not begun.is_set():
            await asyncio.sleep(0)
        for name in ("other", "newcomer"):
            work = partial(made.append, name)
            tasks.append(asyncio.create_task(preparations.make(work, is_new=name == "newcomer")))
        for _ in range(20):
            await asyncio.sleep(0)
            looks += not made
        end.set()
        await asyncio.gather(*tasks)
        return made, looks

    assert asyncio.run(main()) == (["held", "newcomer", "other"], 20)


def test_a_preparation_that_fails_or_is_cancelled_lets_the_next_begin() -> None:
    async def main() -> list[str]:
        preparations, made = Preparations(), list[str]()

        def fails() -> None:
            raise FormatError(Path("x"), "", "a set", "none", "remedy")

        tasks = [asyncio.create_task(preparations.make(fails)) for _ in range(2)]
        await asyncio.sleep(0)
        tasks[1].cancel()
        await preparations.make(partial(made.append, "next"))
        found = await asyncio.gather(*tasks, return_exceptions=True)
        return [*made, *(type(error).__name__ for error in found)]

    assert asyncio.run(main()) == ["next", "FormatError", "CancelledError"]


class Costs:
    """A clock that stands still but for what reading takes."""

    def __init__(self) -> None:
        self.now, self.read = 0.0, list[str]()

    def measure(self) -> float:
        return self.now

    def reader(self, name: str, cost: float, slices: int) -> Callable[[], bool]:
        """Return a function that reads so many slices, each for `cost` seconds."""
        left = [slices]

        def read() -> bool:
            self.now += cost
            self.read.append(name)
            left[0] -= 1
            return left[0] > 0

        return read


def test_readers_share_time_and_not_slices() -> None:
    async def main() -> None:
        costs = Costs()
        readings = Readings(costs.measure)
        readings.add(costs.reader("slow", 0.001, 100))
        readings.add(costs.reader("quick", 0.00001, 100))
        turns = 0
        while "quick" not in costs.read or costs.read.count("quick") < 100:
            before = costs.now
            await asyncio.sleep(0)
            assert costs.now - before < 0.0035  # between two looks at the sockets: 2 ms, and the last slice
            turns += 1
        assert costs.read.count("slow") <= 4
        assert turns <= 3
        while costs.read.count("slow") < 100:
            await asyncio.sleep(0)
        assert readings._waiting == type(readings._waiting)()

    asyncio.run(main())


def test_a_reader_that_fails_ends_alone() -> None:
    async def main() -> None:
        costs, failed = Costs(), []
        asyncio.get_running_loop().set_exception_handler(lambda loop, about: failed.append(about["exception"]))
        readings = Readings(costs.measure)

        def fails() -> bool:
            raise RuntimeError("no")

        readings.add(fails)
        readings.add(costs.reader("other", 0.001, 9))
        for _ in range(20):
            await asyncio.sleep(0)
        assert costs.read == ["other"] * 9
        assert [str(error) for error in failed] == ["no"]
        readings.add(costs.reader("later", 0.001, 1))
        await asyncio.sleep(0)
        assert costs.read[-1] == "later"

    asyncio.run(main())
