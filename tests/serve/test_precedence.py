"""Precedence: viewers in every turn, all others in slots, each in its turn, for a share of the processor."""

from __future__ import annotations

import asyncio
import selectors
import socket
from contextlib import ExitStack
from pathlib import Path

import pytest

from gsvis.serve.precedence import _EVENTS, _SHARE, Precedence, run
from gsvis.serve.turns import Readings
from tests.serve.servers import heard, phases, plain_socket, raw, serving, until

VIEWER, OTHERS = 1, range(10, 40)


def ready(*fds: int) -> list[tuple[selectors.SelectorKey, int]]:
    return [(selectors.SelectorKey(fd, fd, selectors.EVENT_READ, None), selectors.EVENT_READ) for fd in fds]


class House:
    """A precedence with sockets behind, and the processor's time as a test lets it pass."""

    def __init__(self) -> None:
        self.now = 0.0
        self.precedence = Precedence(lambda: self.now)
        for fd in OTHERS:
            self.precedence.put(fd, self, is_first=False)

    def turn(self, *fds: int, is_busy: bool = False, event_s: float = 0.0) -> list[int]:
        """Return the sockets that a turn handles, each for so many seconds."""
        self.precedence.end_turn()
        chosen = [key.fd for key, _ in self.precedence.choose(ready(*fds), is_busy=is_busy)]
        self.now += event_s * len(chosen)
        return chosen


def test_sockets_of_viewers_are_handled_in_every_turn_and_first() -> None:
    house = House()
    for _ in range(50):
        chosen = house.turn(*OTHERS, VIEWER, is_busy=True, event_s=0.001)
        assert chosen[0] == VIEWER
        assert len(chosen) <= 1 + _EVENTS


def test_others_need_not_wait_while_viewers_want_nothing() -> None:
    house = House()
    for _ in range(20):
        assert len(house.turn(*OTHERS, event_s=0.001)) == _EVENTS
        assert house.turn(11, event_s=0.001) == [11]
        assert house.turn() == []


@pytest.mark.parametrize("is_busy", [True, False])
def test_none_waits_for_one_that_is_always_ready(is_busy: bool) -> None:
    house, slots, enough = House(), list[list[int]](), -(-len(OTHERS) // _EVENTS)
    while len(slots) < 10 * enough:
        chosen = house.turn(*OTHERS, VIEWER, is_busy=is_busy, event_s=0.001)
        slots += [chosen[1:]] if len(chosen) > 1 else []
    for k in range(len(slots) - enough):
        assert {fd for slot in slots[k : k + enough] for fd in slot} == set(OTHERS)


def test_whoever_is_no_longer_ready_loses_the_place() -> None:
    house = House()
    house.turn(10, event_s=0.001)
    assert house.turn(11, 12, is_busy=True) == []
    assert house.turn(12, 13, is_busy=True) == []
    house.now += 1.0
    assert house.turn(13, 11, 12, is_busy=True) == [12, 13, 11]


def test_others_get_a_share_while_viewers_want_everything() -> None:
    """Slots take at most their share, and no less than what is left of it after the turns of viewers."""
    house, spent, turns = House(), 0.0, 4000
    for _ in range(turns):
        chosen = house.turn(*OTHERS, VIEWER, is_busy=True)
        spent += 0.0005 * (len(chosen) - 1)
        house.now += 0.0005 * (len(chosen) - 1) + 0.0001
    assert 0.8 * _SHARE <= spent / house.now <= _SHARE


def test_a_dear_slot_is_paid_for() -> None:
    house = House()
    assert house.turn(10, VIEWER, event_s=0.05) == [VIEWER, 10]
    until_due = 0
    while 11 not in house.turn(11, VIEWER):
        house.now += 0.001
        until_due += 1
    assert until_due * 0.001 == pytest.approx(0.1 * (1.0 / _SHARE - 1.0), abs=0.002)


def test_calls_are_made_in_slots_and_once() -> None:
    async def main() -> None:
        house, made = House(), list[int]()
        house.turn(10, event_s=0.001)
        house.turn()
        house.precedence.call(lambda: made.append(1))
        for _ in range(3):
            house.turn(VIEWER)
            await asyncio.sleep(0)
        assert made == []
        assert house.precedence.has_calls
        house.turn()
        await asyncio.sleep(0)
        house.turn()
        await asyncio.sleep(0)
        assert made == [1]
        assert not house.precedence.has_calls

    asyncio.run(main())


def test_a_number_of_a_socket_that_is_used_again_stays_behind() -> None:
    house, newcomer = House(), object()
    house.precedence.put(10, newcomer, is_first=False)
    house.precedence.forget(10, house)
    house.turn(11, event_s=0.001)
    assert house.turn(10, VIEWER) == [VIEWER]
    house.precedence.put(10, newcomer, is_first=True)
    assert house.turn(10, VIEWER) == [10, VIEWER]


def test_a_loop_looks_at_a_viewer_first_whatever_else_is_ready() -> None:
    seen: list[int] = []

    async def main() -> None:
        loop = asyncio.get_running_loop()
        with ExitStack() as stack:
            ends = [socket.socketpair() for _ in range(41)]
            for near, far in ends:
                stack.enter_context(near)
                stack.enter_context(far)
                far.send(b"x")
            for number, (near, _) in enumerate(ends):
                precedence.put(near.fileno(), near, is_first=number == 40)
                loop.add_reader(near, lambda near=near, number=number: seen.append(number) or near.recv(1))  # type: ignore[misc]
            while len(seen) < 41:
                await asyncio.sleep(0)
            for near, _ in ends:
                loop.remove_reader(near)

    precedence = Precedence(lambda: 0.0)
    run(main(), precedence)
    assert sorted(seen) == list(range(41))
    assert seen[0] == 40


def test_bursts_are_read_in_slots() -> None:
    """The last slice comes although a viewer is ready in every turn."""
    read: list[int] = []

    async def main() -> None:
        loop = asyncio.get_running_loop()
        near, far = socket.socketpair()
        with near, far:
            far.send(b"x")
            loop.add_reader(near, lambda: None)  # never read, so always ready
            Readings(call=precedence.call).add(lambda: read.append(1) or len(read) < 500)  # type: ignore[func-returns-value]
            while len(read) < 500:
                await asyncio.sleep(0)
            loop.remove_reader(near)

    precedence = Precedence()
    run(main(), precedence)
    assert len(read) == 500
    assert not precedence.has_calls


def test_a_server_puts_viewers_first_and_only_them(plain: Path) -> None:
    with serving(plain) as server:
        behind = server._precedence._behind
        with plain_socket(server), raw(server) as viewer:
            heard(viewer)
            until(lambda: phases(server) == ["asking", "streaming"])
            first = [guard for guard in server._server._door.guards if guard.phase.value == "streaming"]
            assert len(behind) == 1
            assert first[0] not in behind.values()
            viewer.send(b"\xff")  # no message: it has to leave
            until(lambda: phases(server) != ["asking", "streaming"])
            assert first[0] in behind.values() or len(phases(server)) == 1
        until(lambda: phases(server) == [])
        assert behind == {}


def test_everything_ends_with_the_loop() -> None:
    ended: list[str] = []

    async def waits() -> None:
        try:
            await asyncio.Event().wait()
        finally:
            ended.append("task")

    async def main() -> None:
        asyncio.get_running_loop().create_task(waits())
        await asyncio.sleep(0)
        raise RuntimeError("no")

    with pytest.raises(RuntimeError, match="no"):
        run(main(), Precedence())
    assert ended == ["task"]
