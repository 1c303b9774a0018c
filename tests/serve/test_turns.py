"""Turns: one task between two looks at the sockets, in the order of asking, whoever leaves."""

from __future__ import annotations

import asyncio

from gsvis.serve.turns import Turns


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
